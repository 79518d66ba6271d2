"""Colours of everything that is drawn: Okabe and Ito's palette, told apart with any colour vision and in grey print."""

BLUE, VERMILLION = "#0072B2", "#D55E00"
# In an order that keeps neighbours apart.
COLOURS = (BLUE, VERMILLION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
WALL_GREY, INK = "#BDBDBD", "#222222"
