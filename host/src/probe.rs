//! Probes and virtual extensometers on a displacement field: what `daic probe` does.

use crate::error::Error;
use crate::strain::{COMPONENTS, Gauge, Options};
use daic_correlate::strain::{self, Elongation, Extensometer, Field, Gradients, Probe, Profile};
use daic_dataset::{Column, Table};
use daic_report::{Chart, Series, SeriesStyle};
use serde_json::{Value, json};

/// What to look at; lengths in pixels of the reference image.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Probes {
    /// Single positions.
    pub points: Vec<[f64; 2]>,
    /// Start and end of lines.
    pub lines: Vec<[[f64; 2]; 2]>,
    /// Positions along a line; `None`: one per grid step.
    pub samples: Option<usize>,
    /// Lengths to watch.
    pub extensometers: Vec<Extensometer>,
}

/// What the probes found.
#[derive(Debug, Clone)]
pub struct Probed {
    /// Window of the strains, if there are any.
    pub gauge: Option<Gauge>,
    /// One per point.
    pub points: Vec<Probe>,
    /// One per line.
    pub lines: Vec<Profile>,
    /// One per extensometer.
    pub extensometers: Vec<Elongation>,
    mm_per_px: Option<f64>,
}

/// Looks at a field. Without `options` there are displacements only.
///
/// # Errors
/// Nothing to look at; positions or settings that cannot be used.
pub fn probe(field: &Field, probes: &Probes, options: Option<&Options>) -> Result<Probed, Error> {
    if probes.points.is_empty() && probes.lines.is_empty() && probes.extensometers.is_empty() {
        return Err(Error::NoProbe);
    }
    let gradients: Option<Gradients> =
        options.map(|options| strain::gradients(field, &options.settings)).transpose()?;
    let with = gradients.as_ref().zip(options.map(|options| options.tensor));
    let samples = |[from, to]: [[f64; 2]; 2]| {
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        // the cast saturates, and the library refuses what is too many
        probes.samples.unwrap_or((length / field.step).round() as usize + 1).max(2)
    };
    let point = |&position: &[f64; 2]| Ok(strain::point(field, with, position)?);
    let line = |&ends: &[[f64; 2]; 2]| Ok(strain::line(field, with, ends[0], ends[1], samples(ends))?);
    Ok(Probed {
        gauge: options.map(|options| Gauge::of(options, field)),
        points: probes.points.iter().map(point).collect::<Result<_, Error>>()?,
        lines: probes.lines.iter().map(line).collect::<Result<_, Error>>()?,
        extensometers: probes
            .extensometers
            .iter()
            .map(|e| Ok(e.measure(field)?))
            .collect::<Result<_, Error>>()?,
        mm_per_px: options.and_then(|options| options.mm_per_px),
    })
}

fn strain_json(probe: &Probe) -> Value {
    probe.strain.map_or(Value::Null, |s| {
        let ([exx, eyy, exy], [sxx, syy, sxy]) = (s.components, s.sigma);
        json!({
            "status": s.status.name(), "exx": exx, "eyy": eyy, "exy": exy,
            "sigma_exx": sxx, "sigma_eyy": syy, "sigma_exy": sxy,
            "e1": s.principal[0], "e2": s.principal[1], "angle_deg": s.angle.to_degrees(),
        })
    })
}

fn probe_json(probe: &Probe) -> Value {
    json!({
        "x": probe.position[0], "y": probe.position[1], "status": probe.status.name(),
        "u": probe.displacement[0], "v": probe.displacement[1],
        "sigma_u": probe.sigma[0], "sigma_v": probe.sigma[1],
        "strain": strain_json(probe),
    })
}

impl Probed {
    /// Everything, as JSON.
    pub fn json(&self) -> Value {
        let lines = self.lines.iter().map(|line| {
            let points = line.points.iter().zip(&line.distance).map(|(probe, distance)| {
                let mut value = probe_json(probe);
                value["distance"] = json!(distance);
                value
            });
            Value::Array(points.collect())
        });
        let extensometers = self.extensometers.iter().map(|e| {
            json!({
                "from": e.ends[0], "to": e.ends[1], "status": e.status.name(), "points": e.used,
                "length_px": e.length, "deformed_length_px": e.deformed_length,
                "length_mm": self.mm_per_px.map(|scale| scale * e.length),
                "strain": e.strain, "sigma_strain": e.sigma,
            })
        });
        json!({
            "gauge": self.gauge,
            "points": self.points.iter().map(probe_json).collect::<Vec<_>>(),
            "lines": lines.collect::<Vec<_>>(),
            "extensometers": extensometers.collect::<Vec<_>>(),
        })
    }

    /// `kind,number,distance,x,y,u,v,sigma_u,sigma_v,exx,eyy,exy,sigma_exx,sigma_eyy,sigma_exy,x_end,y_end,length,deformed_length,strain,sigma_strain,status,strain_status`:
    /// a row per point, sample of a line and extensometer; NaN for what a kind does not have. Pixels.
    ///
    /// # Errors
    /// Only if two columns had one name.
    pub fn table(&self) -> Result<Table, Error> {
        let (mut kind, mut number, mut status, mut strain_status) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        const NAMES: [&str; 13] = [
            "distance",
            "x",
            "y",
            "u",
            "v",
            "sigma_u",
            "sigma_v",
            "exx",
            "eyy",
            "exy",
            "sigma_exx",
            "sigma_eyy",
            "sigma_exy",
        ];
        const LENGTHS: [&str; 6] = ["x_end", "y_end", "length", "deformed_length", "strain", "sigma_strain"];
        let nan = f64::NAN;
        let mut values: Vec<[f64; 19]> = Vec::new();
        let mut add = |name: &str, index: usize, distance: f64, p: &Probe| {
            kind.push(name.to_owned());
            number.push(index as i64 + 1);
            status.push(p.status.name().to_owned());
            strain_status.push(p.strain.map_or("none", |s| s.status.name()).to_owned());
            let ([x, y], [u, v], [su, sv]) = (p.position, p.displacement, p.sigma);
            let e = p.strain.map_or([nan; 3], |s| s.components);
            let s = p.strain.map_or([nan; 3], |s| s.sigma);
            let mut row = [nan; 19];
            row[..13].copy_from_slice(&[distance, x, y, u, v, su, sv, e[0], e[1], e[2], s[0], s[1], s[2]]);
            values.push(row);
        };
        self.points.iter().enumerate().for_each(|(k, p)| add("point", k, 0.0, p));
        for (k, line) in self.lines.iter().enumerate() {
            line.points.iter().zip(&line.distance).for_each(|(p, d)| add("line", k, *d, p));
        }
        for (k, e) in self.extensometers.iter().enumerate() {
            kind.push("extensometer".to_owned());
            number.push(k as i64 + 1);
            status.push(e.status.name().to_owned());
            strain_status.push("none".to_owned());
            let ([x, y], [a, b]) = (e.ends[0], e.ends[1]);
            let mut row = [nan; 19];
            row[1..3].copy_from_slice(&[x, y]);
            row[13..].copy_from_slice(&[a, b, e.length, e.deformed_length, e.strain, e.sigma]);
            values.push(row);
        }
        let mut table = Table::new().with("kind", Column::Text(kind))?.with("number", Column::I64(number))?;
        for (k, name) in NAMES.into_iter().chain(LENGTHS).enumerate() {
            table.push(name, Column::F64(values.iter().map(|row| row[k]).collect()))?;
        }
        Ok(table.with("status", Column::Text(status))?.with("strain_status", Column::Text(strain_status))?)
    }

    /// Displacement, and strain if there is one, along every line, with bands of ± σ. Lines without a
    /// value are left out.
    ///
    /// # Errors
    /// If a figure cannot be drawn.
    pub fn figures(&self) -> Result<Vec<(String, String)>, Error> {
        let mut drawn = Vec::new();
        for (k, line) in self.lines.iter().enumerate() {
            let series = |name: &str, value: &dyn Fn(&Probe) -> (f64, f64)| {
                let found: Vec<(f64, f64)> = line.points.iter().map(value).collect();
                Series {
                    name: name.to_owned(),
                    points: line.distance.iter().zip(&found).map(|(d, f)| (*d, f.0)).collect(),
                    sigma: found.iter().map(|f| f.1).collect(),
                    style: SeriesStyle::Line,
                }
            };
            let chart = |what: &str, y_label: &str, series: Vec<Series>| Chart {
                title: format!("{what} along line {}", k + 1),
                x_label: "distance from the start / px".to_owned(),
                y_label: y_label.to_owned(),
                series,
                y_limits: None,
            };
            if line.points.iter().any(|p| p.status.is_ok()) {
                let both = [("u", 0), ("v", 1)].map(|(n, c)| series(n, &|p| (p.displacement[c], p.sigma[c])));
                let svg = chart("displacement", "displacement / px", both.to_vec()).render_svg()?;
                drawn.push((format!("line-{}-displacement", k + 1), svg.as_str().to_owned()));
            }
            if line.points.iter().any(|p| p.strain.is_some_and(|s| s.status.is_ok())) {
                let value = |c: usize| {
                    move |p: &Probe| p.strain.map_or((f64::NAN, f64::NAN), |s| (s.components[c], s.sigma[c]))
                };
                let all = COMPONENTS.into_iter().enumerate().map(|(c, name)| series(name, &value(c)));
                let svg = chart("strain", "strain", all.collect()).render_svg()?;
                drawn.push((format!("line-{}-strain", k + 1), svg.as_str().to_owned()));
            }
        }
        Ok(drawn)
    }
}
