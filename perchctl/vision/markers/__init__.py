"""Finding the target's two markers in a picture, and their corners to a hundredth of a pixel.

In the order of the imports, each module needing only those before it:

square      a marker's square: sides, area, homographies, squares around and inside it
drawing     a marker's drawing, sharp and blurred
pattern     how a marker looks, and whether the picture shows its cells
profiles    grey values across sides
edges       the edge in each profile
shift       by how much white has grown over black
sides       the edges of all markers' sides
corners     refined corners, and each by its own neighbourhood
lines       corners from lines fitted to the sides
products    products of tall matrices
grid        the picture at the nodes of a grid over a marker
light       what turns a drawing into grey values
likeness    how much the picture looks like a drawing
align       a drawing laid over the picture
by_drawing  corners from the drawing, if the picture looks like it
follow      markers where they are expected
improve     what lines left vague or unseen, by the drawing
detector    dictionaries and patterns, made once
search      markers anywhere
blurred     markers that blur hides
motion      where the markers move
detect      the steps of a frame
"""
