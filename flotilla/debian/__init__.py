"""Locked Debian packages, and what is compiled in trees of them: tools, kernels, the runtime, apps."""
