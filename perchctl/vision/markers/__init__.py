"""Finding the target's two markers in a picture, and their corners to a hundredth of a pixel."""
