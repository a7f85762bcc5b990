"""pyolaf on the problem of `cargo xtask bench lightfield`.

Prints one JSON line for each stage: its name, seconds of processor time and of wall time. Usage:
lightfield_pyolaf.py NNUM S FIRST_UM LAST_UM STEP_UM LENSLETS ITERATIONS (0 iterations: the pattern alone).
"""
import contextlib
import json
import os
import resource
import sys
import tempfile
import time

import numpy as np
import yaml
from pyolaf.geometry import LFM_computeGeometryParameters, LFM_setCameraParams
from pyolaf.lf import (
    LFM_calcPSFAllDepths,
    LFM_computeForwardPatternsWaves,
    LFM_computeLFMatrixOperators,
    LFM_computePSFsize,
    LFM_getUsedCenters,
    LFM_mlaTransmittance,
    LFM_ulensTransmittance,
)
from pyolaf.project import LFM_backwardProject, LFM_forwardProject


@contextlib.contextmanager
def stage(name):
    """Times what is done inside, and keeps its chatter off stdout."""
    wall, cpu = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(sys.stderr):
        yield
    report = {"stage": name, "cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
    print(json.dumps(report), flush=True)


def main():
    nnum, s = int(sys.argv[1]), int(sys.argv[2])
    first, last, step = map(float, sys.argv[3:6])
    lenslets, iterations = int(sys.argv[6]), int(sys.argv[7])
    camera = {
        "gridType": "reg", "focus": "single", "plenoptic": 1, "uLensMask": 1,
        "M": 20, "NA": 0.5, "ftl": 200000.0, "fm": 3000.0, "tube2mla": 0, "mla2sensor": 0,
        "lensPitch": 150.0, "pixelPitch": 150.0 / nnum, "n": 1.0, "WaveLength": 0.45,
    }
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "camera.yaml")
        with open(path, "w") as f:
            yaml.safe_dump(camera, f)
        with contextlib.redirect_stdout(sys.stderr):
            camera = LFM_setCameraParams(path, nnum)
    size = np.array([lenslets * nnum, lenslets * nnum])
    with contextlib.redirect_stdout(sys.stderr):
        centers, resolution, _, _ = LFM_computeGeometryParameters(
            camera, np.array([]), [first, last], step, s, False, size)
        psf_size = LFM_computePSFsize(max(abs(first), abs(last)), camera)
        resolution["usedLensletCenters"] = LFM_getUsedCenters(psf_size, centers)
    if iterations == 0:
        # the pattern of one plane, as far as the light on the sensor
        half = (psf_size + 0.5) * nnum
        grid = np.arange(-np.floor(half), np.floor(half) + 1) * camera["newPixelPitch"]
        resolution["yspace"] = resolution["xspace"] = grid
        lens = np.arange(-(nnum // 2), nnum // 2 + 1) * camera["newPixelPitch"]
        resolution["yMLspace"] = resolution["xMLspace"] = lens
        resolution["maskFlag"] = camera["uLensMask"]
        with stage("psf"):
            stack = LFM_calcPSFAllDepths(camera, resolution)
            array = LFM_mlaTransmittance(camera, resolution, LFM_ulensTransmittance(camera, resolution))
            LFM_computeForwardPatternsWaves(stack, array, camera, resolution)
        return
    with stage("psf"):
        h, ht = LFM_computeLFMatrixOperators(camera, resolution, centers)
    tex = np.ceil(size * np.array(resolution["texScaleFactor"]))
    tex = (tex + (1 - tex % 2)).astype(int)
    rng = np.random.default_rng(1)
    volume = np.zeros((*tex, len(resolution["depths"])), dtype="float32")
    inner = [slice(n // 4, 3 * n // 4) for n in tex]
    volume[inner[0], inner[1]] = rng.random((*[s.stop - s.start for s in inner], volume.shape[2])) < 0.01
    view = camera["range"]
    with stage("forward"):
        image = LFM_forwardProject(h, volume, centers, resolution, size, view)
    with stage("back"):
        LFM_backwardProject(ht, image, centers, resolution, tex, view)
    with stage("iterations"):
        found = np.ones_like(volume)
        for _ in range(iterations):
            estimate = LFM_forwardProject(h, found, centers, resolution, size, view)
            ratio = image / np.maximum(estimate, 1e-9)
            found = found * LFM_backwardProject(ht, ratio.astype("float32"), centers, resolution, tex, view)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"stage": "memory", "peak_mib": peak, "volume": list(volume.shape)}), flush=True)


main()
