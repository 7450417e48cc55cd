"""Detect the target's two markers in an image, with corners accurate to 0.01 px."""
