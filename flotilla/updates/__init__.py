"""Updates of robots that run: what is sent, and how it goes through the air."""
