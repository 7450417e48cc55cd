// The magnet gear of docs/parts.md: a bridge that plugs onto the deck pins, with a ring magnet on top.
// Units: mm. Print it upright and solid, in PLA or PETG; it needs no supports, and one bridge of 19 mm.
// openscad -o gear.stl docs/gear.scad
// Nobody has printed or flown it yet.

// From the deck under the gear to the top of the magnet. Larger: more room between the camera and the
// sheet, and a longer lever. Smaller: the camera may become the highest point.
height = 18;

// Ring magnet MP 12x5x2. The magnet must be the highest point, so its pin ends below its top.
magnet_outer = 12;
magnet_inner = 5;
magnet_height = 2;
pin_clearance = 0.2;  // of the pin in the hole, on the diameter and on the height

// Deck connector: two rows of 10 pins, 2 mm apart, 22 mm from row to row.
rows = 22;
row_length = 20;
slot = 0.8;           // takes pins of 0.5 mm; smaller: holds tighter, and may not slide on
foot_width = 3;
foot_height = 4;

bridge_width = 6;
bridge_height = 2;
mast = 5;             // diameter
seat_height = 1.2;    // the disc under the magnet
cone = 3.5;           // under the seat: 45 deg

$fn = 64;

module foot() {
    difference() {
        translate([-row_length / 2, -foot_width / 2, 0]) cube([row_length, foot_width, foot_height]);
        // Open below, closed above, so that the pins cannot touch anything.
        translate([-row_length / 2 + 0.5, -slot / 2, -1]) cube([row_length - 1, slot, foot_height]);
    }
}

module gear() {
    seat_top = height - magnet_height;
    for (side = [-1, 1]) translate([0, side * rows / 2, 0]) foot();
    translate([-bridge_width / 2, -rows / 2 - foot_width / 2, foot_height - bridge_height])
        cube([bridge_width, rows + foot_width, bridge_height]);
    translate([0, 0, foot_height - bridge_height])
        cylinder(d = mast, h = seat_top - foot_height + bridge_height);
    // A cone under the seat prints without supports, and spreads the load of a hard contact.
    translate([0, 0, seat_top - seat_height - cone]) cylinder(d1 = mast, d2 = magnet_outer, h = cone);
    translate([0, 0, seat_top - seat_height]) cylinder(d = magnet_outer, h = seat_height);
    translate([0, 0, seat_top])
        cylinder(d = magnet_inner - pin_clearance, h = magnet_height - pin_clearance);
}

gear();
