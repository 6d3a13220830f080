"""Power cuts replayed: every state in which one can leave a card while software is updated, started and judged."""
