"""How the camera is turned in the vehicle, how late its pictures are, and where the gear's tip is:
measured from a vehicle that is moved by hand in view of the target."""
