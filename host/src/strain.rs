//! Strain of a displacement field: what `daic strain` does.

use crate::error::Error;
use crate::figures;
use crate::measure::spread;
use daic_correlate::strain::{Field, Gradients, Settings, Strain, StrainStatus, Tensor, gradients};
use daic_dataset::{Column, FloatMap, MapAxes, Table};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How strain is computed and stated.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Window and fit.
    pub settings: Settings,
    /// Strain measure.
    pub tensor: Tensor,
    /// Size of a pixel on the object, mm; to state the gauge in mm.
    pub mm_per_px: Option<f64>,
}

/// Names of the components in files and figures.
pub const COMPONENTS: [&str; 3] = ["exx", "eyy", "exy"];

/// Side of the virtual strain gauge and what it is made of.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gauge {
    /// Points along the side of the window.
    pub window_points: usize,
    /// Distance of points, pixels.
    pub step_px: f64,
    /// Side of the subsets, pixels.
    pub subset_px: usize,
    /// (window − 1) · step + subset, pixels.
    pub gauge_px: f64,
    /// The same on the object; `None` without a scale.
    pub gauge_mm: Option<f64>,
    /// The fit.
    pub method: String,
}

impl Gauge {
    /// The gauge of these options on that field.
    pub fn of(options: &Options, field: &Field) -> Self {
        let gauge_px = options.settings.gauge(field.step, field.subset);
        Self {
            window_points: options.settings.window,
            step_px: field.step,
            subset_px: field.subset,
            gauge_px,
            gauge_mm: options.mm_per_px.map(|scale| scale * gauge_px),
            method: options.settings.method.to_string(),
        }
    }
}

impl std::fmt::Display for Gauge {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mm = match self.gauge_mm {
            Some(mm) => format!(" = {mm:.4} mm"),
            None => " (in mm with --scale)".to_owned(),
        };
        let (w, step, subset) = (self.window_points, self.step_px, self.subset_px);
        write!(
            f,
            "virtual strain gauge {} px{mm}: ({w} − 1) × {step} px step + {subset} px subset; {}",
            self.gauge_px, self.method
        )
    }
}

/// Mean and scatter over the field, and the stated uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ComponentSummary {
    /// Mean.
    pub mean: f64,
    /// Standard deviation over the points.
    pub std: f64,
    /// Root mean square of the stated uncertainties.
    pub sigma: f64,
}

/// Summary of a strain field.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Nodes of the grid.
    pub points: usize,
    /// Nodes with a strain.
    pub ok: usize,
    /// Nodes per status.
    pub status: BTreeMap<&'static str, usize>,
    /// Strain measure.
    pub tensor: &'static str,
    /// Window in points, pixels, mm.
    pub gauge: Gauge,
    /// e_xx.
    pub exx: ComponentSummary,
    /// e_yy.
    pub eyy: ComponentSummary,
    /// e_xy, the tensor's: half of γ.
    pub exy: ComponentSummary,
    /// Greatest principal strain.
    pub e1_max: f64,
    /// Smallest principal strain.
    pub e2_min: f64,
    /// Mean rotation, degrees, from x towards y.
    pub rotation_deg: f64,
}

/// A displacement field with its strain.
#[derive(Debug, Clone)]
pub struct StrainField {
    /// The displacements.
    pub field: Field,
    /// How strain was computed.
    pub options: Options,
    /// Gradients, a node each.
    pub gradients: Gradients,
    /// Strain, a node each.
    pub strains: Vec<Strain>,
}

impl StrainField {
    /// Computes the strain of a field.
    ///
    /// # Errors
    /// Settings that cannot be used for this field.
    pub fn new(field: Field, options: Options) -> Result<Self, Error> {
        let gradients = gradients(&field, &options.settings)?;
        let strains = gradients.strains(options.tensor);
        Ok(Self { field, options, gradients, strains })
    }

    /// Mean, scatter and stated uncertainty of component 0, 1, 2: e_xx, e_yy, e_xy.
    pub fn component(&self, c: usize) -> ComponentSummary {
        let values = spread(self.strains.iter().map(|s| s.components[c]));
        let sigma = spread(self.strains.iter().map(|s| s.sigma[c])).rms;
        ComponentSummary { mean: values.mean, std: values.std, sigma }
    }

    /// What came out.
    pub fn summary(&self) -> Summary {
        let mut status: BTreeMap<&'static str, usize> = BTreeMap::new();
        for strain in &self.strains {
            *status.entry(strain.status.name()).or_default() += 1;
        }
        let ok = || self.strains.iter().filter(|s| s.status.is_ok());
        let [exx, eyy, exy] = [0, 1, 2].map(|c| self.component(c));
        Summary {
            points: self.strains.len(),
            ok: ok().count(),
            status,
            tensor: self.options.tensor.name(),
            gauge: Gauge::of(&self.options, &self.field),
            exx,
            eyy,
            exy,
            e1_max: ok().map(|s| s.principal[0]).fold(f64::NAN, f64::max),
            e2_min: ok().map(|s| s.principal[1]).fold(f64::NAN, f64::min),
            rotation_deg: spread(ok().map(|s| s.rotation)).mean.to_degrees(),
        }
    }

    /// `x,y,u,v,exx,eyy,exy,sigma_exx,sigma_eyy,sigma_exy,e1,e2,angle_deg,von_mises,rotation_deg,used,status`,
    /// a row per node of the grid that has a displacement or a reason; u and v as measured.
    ///
    /// # Errors
    /// Only if two columns had one name.
    pub fn table(&self) -> Result<Table, Error> {
        let nodes = || 0..self.strains.len();
        let column = |f: &dyn Fn(&Strain) -> f64| Column::F64(self.strains.iter().map(f).collect());
        let place = |c: usize| Column::F64(nodes().map(|n| self.field.position(n)[c]).collect());
        let moved = |values: &[f64]| {
            Column::F64(nodes().map(|n| if self.field.is_valid(n) { values[n] } else { f64::NAN }).collect())
        };
        let mut table = Table::new()
            .with("x", place(0))?
            .with("y", place(1))?
            .with("u", moved(&self.field.u))?
            .with("v", moved(&self.field.v))?;
        for (c, name) in COMPONENTS.into_iter().enumerate() {
            table.push(name, column(&|s| s.components[c]))?;
        }
        for (c, name) in COMPONENTS.into_iter().enumerate() {
            table.push(&format!("sigma_{name}"), column(&|s| s.sigma[c]))?;
        }
        let codes = self.strains.iter().map(|s| s.status as u8).collect();
        let legend = StrainStatus::ALL.map(|s| s.name().to_owned()).to_vec();
        Ok(table
            .with("e1", column(&|s| s.principal[0]))?
            .with("e2", column(&|s| s.principal[1]))?
            .with("angle_deg", column(&|s| s.angle.to_degrees()))?
            .with("von_mises", column(&|s| s.von_mises))?
            .with("rotation_deg", column(&|s| s.rotation.to_degrees()))?
            .with("used", Column::I64(self.strains.iter().map(|s| i64::from(s.used)).collect()))?
            .with("status", Column::Coded { codes, legend })?)
    }

    /// e_xx, e_yy, e_xy as figures with axes and colour bar.
    ///
    /// # Errors
    /// If a figure cannot be drawn.
    pub fn figures(&self) -> Result<Vec<(&'static str, String)>, Error> {
        let gauge = self.options.settings.gauge(self.field.step, self.field.subset);
        let draw = |(c, name): (usize, &'static str)| {
            let map = map_of(&self.field, name, "", self.strains.iter().map(|s| s.components[c]).collect());
            let title = format!("{name}, {}, gauge {gauge} px", self.options.tensor);
            Ok((name, figures::map_svg(&map, &title, name)?))
        };
        COMPONENTS.into_iter().enumerate().map(draw).collect()
    }
}

/// Values at the nodes of a field as a map.
pub fn map_of(field: &Field, name: &str, unit: &str, data: Vec<f64>) -> FloatMap {
    FloatMap {
        name: name.to_owned(),
        unit: unit.to_owned(),
        width: field.columns as u32,
        height: field.rows as u32,
        data,
        axes: MapAxes { x0: field.x0, dx: field.step, y0: field.y0, dy: field.step, unit: "px".to_owned() },
    }
}

/// Writes drawings as `NAME.svg` into a folder, which is made; returns the files.
///
/// # Errors
/// The folder or file that could not be written.
pub fn write_figures(folder: &Path, drawn: &[(impl AsRef<str>, String)]) -> Result<Vec<PathBuf>, Error> {
    std::fs::create_dir_all(folder).map_err(|source| Error::Folder { path: folder.to_owned(), source })?;
    let mut files = Vec::with_capacity(drawn.len());
    for (name, svg) in drawn {
        let path = folder.join(format!("{}.svg", name.as_ref()));
        daic_dataset::atomic::write_bytes(&path, svg.as_bytes())?;
        files.push(path);
    }
    Ok(files)
}
