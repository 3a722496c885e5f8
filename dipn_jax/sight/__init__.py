"""What the camera sees, what it would see after predicted motions, and masks."""
