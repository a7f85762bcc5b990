"""Correlates one image pair with pyvale and prints one JSON object per repeat.

pyvale_dic.py REF DEF SUBSET SHAPE REPEATS OUT

The processor time is that of `pyvale.dic.calculate_2d` alone, on arrays that are already in memory: the
import of pyvale and the reading of images are not counted; the results, which it can only hand out as a
file, are written in its binary form within the call. One thread; the scan method is the fastest of
pyvale's three on these images; its Gaussian prefilter is off, as for every engine that it is compared
with. The stop criterion, step and points are those of the other rows.
"""

import glob
import json
import os
import resource
import shutil
import sys
import time

import numpy as np
from PIL import Image

import pyvale
from pyvale import dic

MARGIN = 40
STEP = 5


def cpu():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main():
    reference_path, deformed_path, subset, shape, repeats, out = sys.argv[1:7]
    subset, repeats = int(subset), int(repeats)
    reference = np.array(Image.open(reference_path).convert("L"))
    deformed = np.array(Image.open(deformed_path).convert("L"))
    height, width = reference.shape
    reach = subset // 2
    roi = np.zeros(reference.shape, dtype=bool)
    roi[MARGIN - reach : height - MARGIN + reach, MARGIN - reach : width - MARGIN + reach] = True
    seed = [width // 2, height // 2]
    for _ in range(repeats):
        shutil.rmtree(out, ignore_errors=True)
        os.makedirs(out)
        start, used = time.perf_counter(), cpu()
        dic.calculate_2d(
            reference=reference,
            deformed=deformed,
            roi_mask=roi,
            seed=seed,
            subset_size=subset,
            subset_step=STEP,
            shape_function=shape,
            correlation_criteria="ZNSSD",
            interpolation_routine="BSPLINE",
            method="SINGLEWINDOW_RG",
            max_displacement=16,
            precision=1e-3,
            threshold=0.5,
            num_threads=1,
            image_filter_kernel=1,
            output_basepath=out,
            output_binary=True,
            output_below_threshold=True,
            print_level=0,
        )
        used, wall = cpu() - used, time.perf_counter() - start
        file = glob.glob(os.path.join(out, "*"))[0]
        results = dic.import_2d(data=file, delimiter=",", binary=True, layout="column", print_level=0)
        x, y = np.ravel(results.ss_x), np.ravel(results.ss_y)
        u, v = np.ravel(results.u_px), np.ravel(results.v_px)
        ok = np.ravel(results.converged).astype(bool) & np.isfinite(u)
        csv = os.path.join(out, "points.csv")
        np.savetxt(csv, np.column_stack([x, y, u, v, ok]), delimiter=",", header="x,y,u,v,ok", comments="")
        print(
            json.dumps(
                {
                    "version": pyvale.__version__,
                    "points": int(len(x)),
                    "ok": int(ok.sum()),
                    "cpu": used,
                    "wall": wall,
                    "csv": csv,
                }
            ),
            flush=True,
        )


main()
