"""The card image builder: from the fleet's description and a package lock to images that can be flashed."""
