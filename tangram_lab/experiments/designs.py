"""Designs of the package's puzzles.

A figure is one or more parts, apart by "/". A part is the letters of its tans (L, M, S: triangles;
Q: square; P, R: parallelogram and its mirror image), then the corners of the outline that they
fill, then ^turn (times 45 degrees, about the first corner) and @x,y (where the first corner goes).
A single tan needs no outline. Lengths are in legs of the small triangle; r is the root of 2, h is
half of it.
"""

TRAIN = {
    "square": "LLMSSQP 2,0 4,2 2,4 0,2 ^1",
    "rectangle": "LLMSSQR 0,0 4,0 4,2 0,2",
    "triangle": "LLMSSQP 0,0 4,0 0,4 ^5",
    "parallelogram": "LLMSSQR 0,0 4,0 6,2 2,2",
    "hexagon": "LLMSSQP 0,0 2,0 3,1 3,3 1,3 0,2",
    "arrow": "LL 0,0 4,0 2,2 @0,4 / MSSQP 0,0 1,0 1,4 0,4 @1.5,0",
    "double_arrow": "MSSQR 0,0 4,0 4,1 0,1 / L ^3 @4+r,0.5 / L ^7 @-r,0.5",
    "letter_d": "MSSQP 0,0 1,0 1,4 0,4 / LL 0,0 2,2 0,4 @1,0",
    "letter_l": "LLMSSQR 0,0 4,0 4,1 2,1 2,3 0,3",
    "stairs": "LLMSSQP 0,0 4,0 4,1 3,1 3,2 1,2 1,3 0,3",
    "house": "LL 0,0 4,0 2,2 @0,1 / MSSQ 0,0 3,0 3,1 0,1 @0.5,0 / P 0,0 1,-1 1,0 0,1 @2.5,2.5",
    "factory": "LLMSSQP 0,0 5,0 5,2 4,1 4,2 3,1 1,1 1,3 0,3",
    "bridge": "LLMSSQR 0,0 1,0 2,1 3,1 4,0 5,0 5,2 0,2",
    "boat": "MSSQP 0,1 1,0 4,0 5,1 / LL 0,0 4,0 2,2 @0.5,1",
    "steamer": "LLMSSQP 2,0 3,0 5,2 3,2 3,3 4,4 3,4 2,3 2,2 0,2",
    "rocket": "M @0,3 / LL 0,0 2,0 2,2 0,2 @0,1 / S @2,1 / S ^2 @0,1 / Q @0.5,0 / R @1.5,-1",
    "candle": "MSSP 0,0 4,0 3,1 1,1 / LL 0,0 2,0 2,2 0,2 @1,1 / Q ^1 @2,3",
    "lamp": "MSSQR 0,0 3,0 2,1 2,3 1,3 1,1 / LL 0,0 4,0 2,2 @-0.5,3",
    "goblet": "LLMSSQP 0,0 3,0 2,1 2,2 3,3 3,4 0,4 0,3 1,2 1,1",
    "spool": "LLMSSQP 0,0 4,0 3,1 3,2 4,3 0,3 1,2 1,1",
    "crown": "LLMSSQR 0,0 4,0 4,3 2,1 0,3",
    "hat": "LLMSSQP 0,0 4,0 4,1 3,1 3,3 1,3 1,1 0,1",
    "flag": "MSSQR 0,0 1,0 1,4 0,4 / LL 0,0 2,0 2,2 0,2 @1,2",
    "mushroom": "LLMSSQP 2,0 3,0 3,2 5,2 3,4 2,4 0,2 2,2",
    "tree": "LL 0,0 4,0 2,2 @0,2 / M @1,4 / Q @1.5,1 / SSP 0,1 1,0 2,0 3,1 @0.5,1",
    "lady": "LL 0,0 4,0 2,2 / M ^4 @3,3 / Q ^1 @2,3 / P @2,2 / S ^6 @1,0 / S ^4 @3,0",
    "cat": "Q ^1 @0,0 / S ^7 @0,r / S ^3 @0,r / M @-1,-1 / LL 0,0 2,0 2,2 0,2 @-1,-3 / P @1,-3",
    "dog": "LLMSSQP 0,0 1,1 3,1 4,0 4,2 5,3 4,3 3,2 1,2 1,3 0,4 0,3 -1,2 0,2",
    "horse": "LLMSSQR 0,0 1,1 3,1 4,0 4,1 5,1 4,2 1,2 0,3 0,4 -1,4 -2,3 -1,3 0,2",
    "elephant": "LLMSSQR 0,0 1,1 3,1 4,0 4,1 5,1 4,2 0,2 0,3 -1,2 -2,1 -2,0 -1,1 0,1",
    "rabbit": "LLMSSQP 1,0 4,0 1,3 2,4 1,4 0,3 0,1",
    "duck": "LLMSSQP 1,0 3,0 5,2 2,2 2,3 1,4 1,3 0,2 1,2",
    "whale": "LLMSSQP 0,1 1,0 3,0 5,2 6,3 5,3 4,2 1,2",
    "fish": "LL 0,0 2,0 2,2 0,2 ^1 @0,0 / MSS 0,0 2,0 0,2 ^7 @r,r / R ^7 @0,2r / Q ^7 @0,0",
    "butterfly": (
        "L ^7 @0,0 / L ^3 @0,0 / Q ^1 @0,0 / M @-1,-1 / S ^7 @0,r / S ^3 @0,r / P @-1,-2"
    ),
}
TEST = {
    "trapezoid": "LLMSSQP 0,0 6,0 4,2 2,2",
    "heart": "LLMSSQP 0,0 3,0 3,2 2,2 2,3 0,3 ^1",
    "church": "LLMSSQP 0,0 5,0 5,1 2,1 2,2 1,3 0,2",
    "airplane": "MSSQP 0,0 1,0 1,4 0,4 / L @1,1 / L ^2 @0,1",
    "umbrella": "MSSQR 0,0 2,0 2,3 1,3 1,1 0,1 / LL 0,0 4,0 2,2 @-0.5,3",
    "teapot": "LLMSSQP 1,0 3,0 4,1 5,2 5,3 4,2 0,2 0,1",
    "swan": "LLMSSQP 2,0 3,0 5,2 2,2 2,3 1,4 0,4 0,3 1,3 1,1",
    "wolf": "LLMSSQP 0,0 1,1 3,1 4,0 4,2 5,3 4,3 3,2 1,2 1,4 -1,2 0,2",
    "camel": "LLMSSQP 0,0 1,1 3,1 4,0 4,2 3,2 2,3 1,2 0,2 -1,3 -2,3 -2,2 -1,2 0,1",
    # with a hole
    "hut": "LL 0,0 4,0 2,2 @-0.5,2 / Q @0,1 / SS 0,0 1,0 1,1 0,1 @2,1 / MR 0,1 1,0 2,0 3,1",
    "lantern": (
        "L ^6 @0,3 / L ^4 @4,3 / S ^2 @1,1 / S @3,1 / Q @1.5,3 / MR 0,1 1,0 2,0 3,1 @0.5,1"
    ),
    # of several areas
    "exclamation_mark": "LLMSSP 0,1 1,0 2,1 2,4 0,4 / Q ^1 @1,-2",
    "sun_over_mountains": "LLMSSP 0,0 6,0 4,2 3,1 2,2 / Q ^1 @4.5,3",
    "two_squares": "LL 0,0 2,0 2,2 0,2 / MSSQP 0,0 2,0 2,2 0,2 @3,0",
}
PAPER = {
    "cat_of_six": "Q ^1 @0,0 / S ^7 @0,r / S ^3 @0,r / L ^7 @-h,-h / L @h,-1.5r / P ^7 @2,-r",
}
