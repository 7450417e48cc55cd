"""Finding the target's two markers in a picture, and their corners to a hundredth of a pixel.

In the order of the imports, each module needing only those before it:

corners          a marker's square, and its corners as they were refined
pattern          how a marker looks, its drawing, and whether the picture shows its cells
detector         dictionaries, patterns and the mask of the vehicle's gear, made once
photometric_fit  a marker's drawing laid over the picture, with its light and blur
edge_fit         the edges of markers' sides, corners from the lines through them, and by how much
                 white has grown over black
partial          markers of which a part is hidden
cut              the target where the picture cuts both of its markers
blurred          markers that blur hides
search           markers anywhere
detect           the steps of a frame
"""
