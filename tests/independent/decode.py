#!/usr/bin/env python3
"""Decodes pixel pairs by formulas of its own and compares with what `daic decode` wrote.

    decode.py OPTICS.json PAIRS.csv POINTS.csv ray|closed|linear

Shares no code with the program and needs nothing but Python. The rays are followed surface by surface (Snell's law in
vector form on both sides of the glass), where the program shifts them once; the point is the middle of the shortest
segment between both rays, found by normal equations. `closed` and `linear` are the formulas of the virtual object as
they are printed, misprints put right. Prints the largest differences, in mm, and fails above 1e-9 mm: 1 pm.
"""

import csv
import json
import math
import sys

LIMIT_MM = 1e-9


def add(a, b):
    return [x + y for x, y in zip(a, b)]


def sub(a, b):
    return [x - y for x, y in zip(a, b)]


def mul(a, t):
    return [x * t for x in a]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def unit(a):
    return mul(a, 1.0 / math.sqrt(dot(a, a)))


def rotation(tilt):
    """R = Rz Ry Rx as rows."""
    (a, b, c) = tilt
    rx = [[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]
    ry = [[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]]
    rz = [[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]]

    def times(m, n):
        return [[sum(m[i][k] * n[k][j] for k in range(3)) for j in range(3)] for i in range(3)]

    return times(rz, times(ry, rx))


def apply(m, v):
    return [dot(row, v) for row in m]


def transposed(m):
    return [list(column) for column in zip(*m)]


def ideal(optics, pixel):
    """Normalised coordinates without distortion: fixed-point iteration of Brown's formula."""
    camera = optics["camera"]
    b = camera["brown"]
    focal = camera["focal_px"]
    xd, yd = [(p - c) / focal for p, c in zip(pixel, camera["principal_point_px"])]
    x, y = xd, yd
    for _ in range(200):
        r2 = x * x + y * y
        radial = 1 + b["k1"] * r2 + b["k2"] * r2**2 + b["k3"] * r2**3
        dx = 2 * b["p1"] * x * y + b["p2"] * (r2 + 2 * x * x)
        dy = b["p1"] * (r2 + 2 * y * y) + 2 * b["p2"] * x * y
        x, y = (xd - dx) / radial, (yd - dy) / radial
    return x, y


def refract(d, n, ratio):
    """Snell: unit direction d through a surface of unit normal n (along the light), index ratio before/after."""
    c = dot(d, n)
    after = math.sqrt(1 - ratio * ratio * (1 - c * c))
    return add(mul(d, ratio), mul(n, after - ratio * c))


def to_plane(p, d, at, n):
    return add(p, mul(d, dot(sub(at, p), n) / dot(d, n)))


def trace(optics, grating, order, q):
    """A point in the air behind the grating and the direction there; world coordinates."""
    r = transposed(rotation(grating["tilt_rad_xyz"]))
    across, normal = r[0], r[2]
    pivot = [0.0, 0.0, optics["pinhole_to_grating_mm"] + grating["offset_mm"]]
    glass = grating["substrate"]
    thickness, index = glass["thickness_mm"], glass["index"]
    kick = mul(across, order * optics["wavelength_mm"] / grating["pitch_mm"])
    d = unit([q[0], q[1], 1.0])
    here = [0.0, 0.0, 0.0]

    def grooves(direction, before, after):
        """Grating equation between two media: the wave vector's part in the plane changes by the kick."""
        wave = mul(direction, before)
        tangential = add(sub(wave, mul(normal, dot(wave, normal))), kick)
        along = math.sqrt(after * after - dot(tangential, tangential))
        return mul(add(tangential, mul(normal, along)), 1.0 / after)

    if thickness == 0.0:
        here = to_plane(here, d, pivot, normal)
        return here, grooves(d, 1.0, 1.0)
    if glass["side"] == "camera":
        here = to_plane(here, d, sub(pivot, mul(normal, thickness)), normal)
        d = refract(d, normal, 1.0 / index)
        here = to_plane(here, d, pivot, normal)
        return here, grooves(d, index, 1.0)
    here = to_plane(here, d, pivot, normal)
    d = grooves(d, 1.0, index)
    here = to_plane(here, d, add(pivot, mul(normal, thickness)), normal)
    return here, refract(d, normal, index)


def by_rays(optics, minus, plus):
    # traced from the pinhole, the view on the left takes the order +1
    a, da = trace(optics, optics["minus"], +1, ideal(optics, minus))
    b, db = trace(optics, optics["plus"], -1, ideal(optics, plus))
    # |a + t da - b - s db|^2 least: two linear equations
    w = sub(a, b)
    aa, ab, bb = dot(da, da), dot(da, db), dot(db, db)
    wa, wb = dot(w, da), dot(w, db)
    det = aa * bb - ab * ab
    t = (ab * wb - bb * wa) / det
    s = (aa * wb - ab * wa) / det
    on_a, on_b = add(a, mul(da, t)), add(b, mul(db, s))
    gap = math.copysign(math.sqrt(dot(sub(on_b, on_a), sub(on_b, on_a))), on_b[1] - on_a[1])
    return mul(add(on_a, on_b), 0.5), gap


def virtual(optics, minus, plus, linear):
    gratings = [optics["minus"], optics["plus"]]
    offset = sum(g["offset_mm"] for g in gratings) / 2
    s = optics["pinhole_to_grating_mm"] + offset
    d = optics["grating_to_reference_mm"] - offset
    theta = math.asin(sum(optics["wavelength_mm"] / g["pitch_mm"] for g in gratings) / 2)
    t, c3 = math.tan(theta), math.cos(theta) ** 3
    focal = optics["camera"]["focal_px"]
    (xm, ym), (xp, yp) = [[c * focal for c in ideal(optics, p)] for p in (minus, plus)]
    u, v = xp - xm, yp - ym
    if linear:
        size = (s + d / c3) / focal
        h = (d - size * u / (2 * t)) * (1 + d / (s * c3))
        scale = size / (1 + h / (s * c3 + d))
    else:
        z = u * s / (2 * focal * t - u / c3)
        h = d - z
        scale = (s + z / c3) / focal
    return [(xm + u / 2) * scale, (ym + v / 2) * scale, s + d - h], v * scale


def to_object(optics, world):
    """(x, y, h) of the reference plane's frame."""
    r = rotation(optics["reference"]["tilt_rad_xyz"])
    x, y = optics["reference"]["origin_mm"]
    z = optics["pinhole_to_grating_mm"] + optics["grating_to_reference_mm"]
    x, y, down = apply(transposed(r), sub(world, [x, y, z]))
    return [x, y, -down]


def main():
    optics_file, pairs_file, points_file, decoder = sys.argv[1:]
    with open(optics_file, encoding="utf-8") as f:
        optics = json.load(f)
    with open(pairs_file, newline="", encoding="utf-8") as f:
        pairs = list(csv.DictReader(f))
    with open(points_file, newline="", encoding="utf-8") as f:
        points = list(csv.DictReader(f))
    if len(pairs) != len(points) or not pairs:
        sys.exit(f"{len(pairs)} pairs, {len(points)} points")
    worst = {"x_mm": 0.0, "y_mm": 0.0, "h_mm": 0.0, "gap_mm": 0.0}
    compared = 0
    for pair, point in zip(pairs, points):
        if point["status"] != "ok":
            continue
        minus = [float(pair["minus_x"]), float(pair["minus_y"])]
        plus = [float(pair["plus_x"]), float(pair["plus_y"])]
        if decoder == "ray":
            world, gap = by_rays(optics, minus, plus)
        else:
            world, gap = virtual(optics, minus, plus, decoder == "linear")
        for name, value in zip(worst, to_object(optics, world) + [gap]):
            worst[name] = max(worst[name], abs(value - float(point[name])))
        compared += 1
    print(f"{decoder}: {compared} points, " + ", ".join(f"{k} {v:.1e}" for k, v in worst.items()))
    if compared == 0 or not max(worst.values()) < LIMIT_MM:
        sys.exit("the program and this script differ")


if __name__ == "__main__":
    main()
