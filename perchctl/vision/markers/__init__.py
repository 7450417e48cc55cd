"""Detect the target's two markers in a picture, with corners accurate to 0.01 px."""
