"""Makes the pages of `docs/reference/` from the sources: `make reference`. Tests compare them."""
