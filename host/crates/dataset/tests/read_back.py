"""Reads files written by daic-dataset with numpy, tifffile and pillow; argument: their folder."""

import csv
import json
import math
import pathlib
import sys

import numpy
import tifffile
from PIL import Image

folder = pathlib.Path(sys.argv[1])
passed = 0


def check(name, holds):
    global passed
    if not holds:
        sys.exit(f"FAILED: {name}")
    passed += 1


u = [0.1 + 0.2, -0.0, 5e-324, sys.float_info.max, math.nan, 1 / 3, -math.inf]
points = numpy.load(folder / "points.npz")
check("npz float", points["u"].dtype == numpy.float64 and numpy.array_equal(points["u"], u, equal_nan=True))
check("npz int", points["x"].dtype == numpy.int64 and points["x"][0] == -(2**63))
legend = json.loads(bytes(points["status_legend"]))
check("npz status", [legend[c] for c in points["status"]][:2] == ["ok", 'low texture, "blank" µ'])
with open(folder / "points.csv", newline="", encoding="utf-8") as file:
    rows = list(csv.DictReader(file))
check("csv float", numpy.array_equal([float(r["u"]) for r in rows], u, equal_nan=True))
check("csv text", rows[4]["name"] == "line\nbreak" and rows[1]["status"] == legend[1])

grey = (numpy.arange(15) * 273).reshape(3, 5)
with tifffile.TiffFile(folder / "f12.tif") as tif:
    image = tif.asarray()
    description = json.loads(tif.pages[0].description)
check("tiff 16", image.dtype == numpy.uint16 and numpy.array_equal(image, grey) and description["significant_bits"] == 12)
image = tifffile.imread(folder / "f8.tif")
check("tiff 8", image.dtype == numpy.uint8 and numpy.array_equal(image, grey // 17))
check("png 16", numpy.array_equal(numpy.asarray(Image.open(folder / "f16.png")), grey))
check("png 8", numpy.array_equal(numpy.asarray(Image.open(folder / "f8.png")), grey // 17))

height = numpy.array([[1, 2, math.nan], [-4, 0.25, 1 / 3]])
with tifffile.TiffFile(folder / "h.tif") as tif:
    codes = tif.asarray()
    scale = json.loads(tif.pages[0].description)
value = numpy.where(codes == scale["no_data"], math.nan, scale["offset"] + scale["scale"] * codes)
close = numpy.allclose(value, height, rtol=0, atol=scale["scale"] * 0.5001, equal_nan=True)
check("map tiff", close and scale["unit"] == "µm")
maps = numpy.load(folder / "maps.npz")
check("map npz", numpy.array_equal(maps["h_mm"], height, equal_nan=True))
print(f"{passed} checks passed")
