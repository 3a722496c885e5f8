"""Files that come with the package: cases, and the trained networks."""
