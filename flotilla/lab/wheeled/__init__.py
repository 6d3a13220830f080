"""The wheeled robot with a boom, driven by the control tasks that its image brings."""
