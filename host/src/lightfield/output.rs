//! Volumes as files and pictures.

use super::error::LightFieldError;
use crate::error::Error;
use daic_dataset::image_file::write_png8;
use daic_dataset::{Volume, VolumeError, atomic};
use daic_report::{
    Chart, ColourScale, Figure, GridAxes, Heatmap, ImageStack, Report, Section, Series, SeriesStyle,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Kind of a volume file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// Multi-page TIFF, 32-bit floating point.
    Tiff,
    /// OME-TIFF.
    OmeTiff,
    /// OME-Zarr 0.5, a folder.
    OmeZarr,
}

impl Format {
    fn ending(self) -> &'static str {
        match self {
            Self::Tiff => "tif",
            Self::OmeTiff => "ome.tif",
            Self::OmeZarr => "ome.zarr",
        }
    }
}

/// Writes a volume in every format, and its maximum-intensity projections `NAME-xy.png`, `-xz.png`, `-zy.png`
/// (white is the largest value). Returns the files.
///
/// # Errors
/// A file that cannot be written.
pub fn write(
    folder: &Path,
    name: &str,
    volume: &Volume<'_>,
    formats: &[Format],
) -> Result<Vec<PathBuf>, Error> {
    let mut written = Vec::new();
    for format in formats {
        let path = stack_path(folder, name, *format);
        match format {
            Format::Tiff => volume.write_tiff(&path),
            Format::OmeTiff => volume.write_ome_tiff(&path),
            Format::OmeZarr => volume.write_ome_zarr(&path),
        }
        .map_err(|e| stack_error(&path, e))?;
        written.push(path);
    }
    let mips = projections(volume.shape, volume.values);
    let largest = volume.values.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    for (suffix, [height, width], values) in mips {
        let path = folder.join(format!("{name}-{suffix}.png"));
        let grey: Vec<u8> = values.iter().map(|v| (255.0 * v / largest).clamp(0.0, 255.0) as u8).collect();
        write_png8(&path, width as u32, height as u32, &grey)?;
        written.push(path);
    }
    Ok(written)
}

/// Where a volume is written.
pub fn stack_path(folder: &Path, name: &str, format: Format) -> PathBuf {
    folder.join(format!("{name}.{}", format.ending()))
}

fn stack_error(path: &Path, error: VolumeError) -> Error {
    match error {
        VolumeError::Write(e) => Error::Write(e),
        other => LightFieldError::Stack { path: path.to_owned(), reason: other.to_string() }.into(),
    }
}

/// A projection: suffix, (rows, columns), values.
pub type Projection = (&'static str, [usize; 2], Vec<f32>);

/// Maximum-intensity projections along z, y and x.
pub fn projections(shape: [usize; 3], values: &[f32]) -> [Projection; 3] {
    let [nz, ny, nx] = shape;
    let mut out = [("xy", [ny, nx]), ("xz", [nz, nx]), ("zy", [ny, nz])]
        .map(|(name, [h, w])| (name, [h, w], vec![0f32; h * w]));
    for z in 0..nz {
        for y in 0..ny {
            for x in 0..nx {
                let v = values[(z * ny + y) * nx + x];
                for (k, at) in [y * nx + x, z * nx + x, y * nz + z].into_iter().enumerate() {
                    let cell = &mut out[k].2[at];
                    *cell = cell.max(v);
                }
            }
        }
    }
    out
}

/// Page of one volume: projections, the stack, the convergence.
///
/// # Errors
/// A figure that cannot be drawn, a page that cannot be written.
pub fn write_report(
    path: &Path,
    name: &str,
    volume: &Volume<'_>,
    curves: &[(&str, &[f64])],
    provenance: Vec<(String, String)>,
) -> Result<(), Error> {
    let [_, ny, _] = volume.shape;
    let [dz, dy, dx] = volume.voxel_um;
    let mut figures = Vec::new();
    for (suffix, [height, width], values) in projections(volume.shape, volume.values) {
        let (along, x, y) = match suffix {
            "xy" => ("z", (0.0, dx), (0.0, dy)),
            "xz" => ("y", (0.0, dx), (volume.first_um, dz)),
            _ => ("x", (volume.first_um, dz), (0.0, dy)),
        };
        let names = match suffix {
            "xy" => ["x", "y"],
            "xz" => ["x", "z"],
            _ => ["z", "y"],
        };
        let values: Vec<f64> = values.iter().map(|v| f64::from(*v)).collect();
        let scale = ColourScale::values(&values);
        let heatmap = Heatmap {
            title: format!("Maximum along {along}"),
            width,
            height,
            values,
            axes: GridAxes { x0: x.0, dx: x.1, y0: y.0, dy: y.1, unit: "µm".into(), names },
            quantity: "g".into(),
            unit: String::new(),
            scale,
        };
        figures.push(Figure {
            id: format!("mip-{suffix}"),
            title: heatmap.title.clone(),
            caption: format!(
                "maximum-intensity projection, {}; the colour bar gives the reconstructed values",
                match suffix {
                    "xy" => "x to the right, y down",
                    "xz" => "x to the right, z down",
                    _ => "z to the right, y down",
                }
            ),
            body: heatmap.render_svg()?,
        });
    }
    let largest = volume.values.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let stack = ImageStack {
        title: "Planes".into(),
        width: volume.shape[2],
        height: ny,
        values: volume.values.to_vec(),
        labels: (0..volume.shape[0])
            .map(|z| format!("z = {:.2} µm", volume.first_um + z as f64 * dz))
            .collect(),
        white: largest,
    };
    figures.push(Figure {
        id: "stack".into(),
        title: "Planes".into(),
        caption: "drag the slider to scroll through the volume".into(),
        body: stack.render_html()?,
    });
    let series: Vec<Series> = curves
        .iter()
        .filter(|(_, v)| !v.is_empty())
        .map(|(name, v)| {
            let points = v.iter().enumerate().map(|(i, v)| (i as f64 + 1.0, *v)).collect();
            Series::new(name, SeriesStyle::Line, points)
        })
        .collect();
    if !series.is_empty() {
        let chart = Chart {
            title: "Convergence".into(),
            x_label: "iteration".into(),
            y_label: "relative".into(),
            series,
            y_limits: None,
        };
        figures.push(Figure {
            id: "convergence".into(),
            title: "Convergence".into(),
            caption: "residual ‖f − Hg‖/‖f‖ before, and change ‖Δg‖/‖g‖ in each iteration".into(),
            body: chart.render_svg()?,
        });
    }
    let report = Report {
        title: format!("Light field: {name}"),
        subtitle: String::new(),
        verdict: None,
        sections: vec![Section { title: "Volume".into(), figures, ..Section::default() }],
        provenance,
    };
    Ok(atomic::write_bytes(path, report.render()?.as_bytes())?)
}
