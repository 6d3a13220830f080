"""The fleet's 802.11 cell as a simulated medium: how long frames take, what is lost, and how many robots it carries."""
