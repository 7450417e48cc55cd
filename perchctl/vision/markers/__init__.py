"""Finding the target's two markers in a picture, and their corners to a hundredth of a pixel.

In the order of the imports, each module needing only those before it:

corners          a marker's square and its corners
pattern          how a marker looks: its cells, its drawing, and the edges of that
detector         dictionaries, patterns and the mask of the vehicle's gear, made once
cells            whether the picture shows a marker's cells
edge_fit         a marker's square by its edges, whole or what is seen of them
photometric_fit  a marker's drawing laid over the picture, with its light and blur
cut              the target where the picture cuts both of its markers
blurred          markers that blur hides
search           markers anywhere
detect           the steps of a frame
"""
