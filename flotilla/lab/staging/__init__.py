"""A release that comes to a robot while its control runs."""
