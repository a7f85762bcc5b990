//! Every kind of figure, from made-up numbers, on one page: `gallery [OUT.html]`.

use std::error::Error;

use daic_report::{
    AnalogTrace, Cell, Chart, ColourMap, ColourScale, DigitalLine, Figure, GridAxes, Heatmap, HeightSurface,
    Limits, Mark, Markup, Overlay, Report, Section, Series, SeriesStyle, TableBlock, Timeline, Verdict,
    plain, with_uncertainty,
};

const TICK_HZ: f64 = 125e6;

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args().nth(1).unwrap_or_else(|| "gallery.html".into());
    let report = Report {
        title: "Gallery of figures".into(),
        subtitle: "Made-up numbers; <b>texts from outside</b> are shown as they are".into(),
        verdict: Some(Verdict {
            pass: true,
            text: "measured minus commanded within 1 µm in-plane and 2 µm out of plane".into(),
        }),
        sections: vec![tables(), maps()?, frames()?, curves()?, timing()?, surfaces()?],
        provenance: vec![
            ("program".into(), "daic 0.1.0".into()),
            ("seed".into(), "1".into()),
            ("settings".into(), "subset 33 px, step 5 px\ndecoder ray".into()),
        ],
    };
    std::fs::write(&out, report.render()?)?;
    eprintln!("written: {out}");
    Ok(())
}

fn figure(id: &str, title: &str, caption: &str, body: Markup) -> Figure {
    Figure { id: id.into(), title: title.into(), caption: caption.into(), body }
}

fn tables() -> Section {
    let row = |axis: &str, commanded: f64, measured: f64, sigma: f64, pass: bool| {
        let difference = measured - commanded;
        let text = plain(difference, 2, "µm");
        vec![
            Cell::Text(axis.into()),
            Cell::Number(plain(commanded, 4, "µm")),
            Cell::Number(with_uncertainty(measured, sigma, "µm")),
            if pass { Cell::Pass(text) } else { Cell::Fail(text) },
        ]
    };
    Section {
        title: "Tables".into(),
        text: vec!["Commanded and measured displacement of the specimen.".into()],
        tables: vec![TableBlock {
            caption: "Displacement".into(),
            head: ["axis", "commanded", "measured", "difference"].map(String::from).into(),
            rows: vec![
                row("x", 50.0, 50.021, 0.034, true),
                row("y", -30.0, -30.004, 0.031, true),
                row("z", 200.0, 203.4, 0.26, false),
            ],
        }],
        figures: vec![],
    }
}

fn cylinder(width: usize, height: usize) -> Vec<f64> {
    (0..width * height)
        .map(|at| {
            let (i, j) = ((at % width) as f64, (at / width) as f64);
            let (x, y) = (i / width as f64 - 0.5, j / height as f64 - 0.5);
            let hole = (x - 0.2).hypot(y + 0.1) < 0.06;
            if hole { f64::NAN } else { 4.0 * (1.0 - 4.0 * x * x).max(0.0).sqrt() + 0.3 * (12.0 * y).sin() }
        })
        .collect()
}

fn map(title: &str, width: usize, height: usize, values: Vec<f64>, scale: ColourScale) -> Heatmap {
    Heatmap {
        title: title.into(),
        width,
        height,
        values,
        axes: GridAxes {
            x0: -9.2,
            dx: 18.4 / width as f64,
            y0: -6.0,
            dy: 18.4 / width as f64,
            unit: "mm".into(),
            names: ["x", "y"],
        },
        quantity: "h".into(),
        unit: "mm".into(),
        scale,
    }
}

fn maps() -> Result<Section, Box<dyn Error>> {
    let heights = cylinder(160, 110);
    let height = map("Height", 160, 110, heights.clone(), ColourScale::values(&heights));
    let errors: Vec<f64> =
        heights.iter().enumerate().map(|(i, h)| h * 0.0 + (i as f64 * 0.7).sin() * 0.4e-3).collect();
    let mut error = map("Height error", 160, 110, errors.clone(), ColourScale::errors(&errors));
    error.quantity = "Δh".into();
    let strip = map(
        "A strip",
        300,
        12,
        cylinder(300, 12),
        ColourScale { map: ColourMap::Cividis, limits: Limits::fixed(0.0, 4.0) },
    );
    let tall = map(
        "Tall and coarse",
        8,
        40,
        cylinder(8, 40),
        ColourScale { map: ColourMap::Viridis, limits: Limits::fixed(0.0, 5.0) },
    );
    let displacement: Vec<f64> = (0..6400).map(|i| 50.0 + f64::from(i % 80) * 1e-3).collect();
    let mut pixels =
        map("Displacement along x", 80, 80, displacement.clone(), ColourScale::values(&displacement));
    pixels.axes = GridAxes { x0: 1200.0, dx: 5.0, y0: 40.0, dy: 5.0, unit: "px".into(), names: ["x", "y"] };
    (pixels.quantity, pixels.unit) = ("u".into(), "µm".into());
    Ok(Section {
        title: "Maps".into(),
        figures: vec![
            figure("height", "Height.", "A cylinder with a hole.", height.render_svg()?),
            figure(
                "error",
                "Error.",
                "Symmetric about zero; grey where there is no value.",
                error.render_svg()?,
            ),
            figure("strip", "Strip.", "Wider than 6 to 1.", strip.render_svg()?),
            figure("tall", "Tall.", "Few nodes.", tall.render_svg()?),
            figure("u", "Displacement.", "Small range on a large value.", pixels.render_svg()?),
        ],
        ..Section::default()
    })
}

fn frames() -> Result<Section, Box<dyn Error>> {
    let (w, h) = (2400usize, 1000usize);
    let grey = (0..w * h)
        .map(|at| {
            let (x, y) = ((at % w) as f64, (at / w) as f64);
            let view = |cx: f64| (x - cx).abs() < 500.0 && (y - 500.0).abs() < 420.0;
            let speckle = ((x * 0.11).sin() * (y * 0.13).cos() + (x * 0.05 - y * 0.07).sin()) * 800.0;
            if view(620.0) || view(1780.0) { (2000.0 + speckle) as u16 } else { 60 }
        })
        .collect();
    let dots =
        (0..900).map(|i| (200.0 + f64::from(i % 30) * 25.0, 150.0 + f64::from(i / 30) * 22.0)).collect();
    let overlay = Overlay {
        title: "Frame 2 with the views that were found".into(),
        width: w,
        height: h,
        grey,
        display: None,
        marks: vec![
            Mark::Dots { points: dots, colour: 1 },
            Mark::rectangle(120.0, 80.0, 1000.0, 840.0, "view −1", 0),
            Mark::rectangle(1280.0, 80.0, 1000.0, 840.0, "view +1", 2),
            Mark::Cross { x: 1199.5, y: 499.5, label: "axis".into(), colour: 4 },
            Mark::Cross { x: 2300.0, y: 40.0, label: "corner".into(), colour: 4 },
        ],
        most_pixels: 900,
    };
    Ok(Section {
        title: "Frames".into(),
        figures: vec![figure("overlay", "Views.", "Both first-order views.", overlay.render_svg()?)],
        ..Section::default()
    })
}

fn curves() -> Result<Section, Box<dyn Error>> {
    let x = |i: i32| f64::from(i) * 0.2 - 10.0;
    let truth: Vec<_> = (0..100).map(|i| (x(i), (100.0 - x(i).powi(2)).max(0.0).sqrt() - 6.0)).collect();
    let gap = |i: usize| if (40..45).contains(&i) { f64::NAN } else { 0.0 };
    let measured: Vec<_> =
        truth.iter().enumerate().map(|(i, p)| (p.0, p.1 + (i as f64).sin() * 0.1 + gap(i))).collect();
    let chart = Chart {
        title: "Section through the cylinder".into(),
        x_label: "x / mm".into(),
        y_label: "h / mm".into(),
        series: vec![
            Series {
                sigma: vec![0.25; 100],
                ..Series::new("measured, ray decoder (± σ)", SeriesStyle::Line, measured.clone())
            },
            Series::new("true shape", SeriesStyle::Dashed, truth),
            Series::new(
                "linear decoder",
                SeriesStyle::Points,
                measured.iter().step_by(4).map(|p| (p.0, p.1 * 0.93)).collect(),
            ),
        ],
        y_limits: None,
    };
    let errors: Vec<f64> =
        (0..4000).map(|i| (f64::from(i) * 1.7).sin() * (f64::from(i) * 0.31).cos() * 0.8e-3).collect();
    let histogram = Chart {
        title: "Distribution of the error".into(),
        x_label: "Δh / mm".into(),
        y_label: "points".into(),
        series: vec![Series::histogram("", &errors, -1e-3, 1e-3, 40)],
        y_limits: None,
    };
    Ok(Section {
        title: "Curves".into(),
        figures: vec![
            figure("section", "Section.", "A gap where points failed.", chart.render_svg()?),
            figure("histogram", "Histogram.", "Bars stand on zero.", histogram.render_svg()?),
        ],
        ..Section::default()
    })
}

fn timing() -> Result<Section, Box<dyn Error>> {
    let us = |t: f64| (t * 1e-6 * TICK_HZ) as u64;
    let frames = [20_000.0, 340_000.0, 660_000.0];
    let pulse = |from: f64, to: f64| [(us(from), true), (us(to), false)];
    let line = |name: &str, edges: Vec<(u64, bool)>| DigitalLine { name: name.into(), initial: false, edges };
    let steps = |from: f64, to: f64, n: u32| -> Vec<(u64, bool)> {
        (0..n)
            .flat_map(|i| {
                let t = from + (to - from) * f64::from(i) / f64::from(n);
                pulse(t, t + 5.0)
            })
            .collect()
    };
    let triggers: Vec<u64> = frames.iter().map(|&t| us(t)).collect();
    let timeline = Timeline {
        title: "Edges played by the trigger box".into(),
        tick_hz: TICK_HZ,
        lines: vec![
            line("camera trigger", frames.iter().flat_map(|&t| pulse(t, t + 10.0)).collect()),
            line("LED 0 strobe", frames.iter().flat_map(|&t| pulse(t + 120.0, t + 140.0)).collect()),
            line(
                "LED 1 strobe",
                frames
                    .iter()
                    .flat_map(|&t| [pulse(t + 200.0, t + 201.0), pulse(t + 210.0, t + 211.0)])
                    .flatten()
                    .collect(),
            ),
            line("stage z step", steps(60_000.0, 200_000.0, 2000)),
            line("stage z direction and more", vec![(us(59_000.0), true), (us(210_000.0), false)]),
        ],
        traces: vec![
            AnalogTrace {
                name: "stage z".into(),
                unit: "µm".into(),
                steps: false,
                points: (0..=100)
                    .map(|i| {
                        let t = f64::from(i) / 100.0;
                        (us(60_000.0 + 140_000.0 * t), 200.0 * t * t * (3.0 - 2.0 * t))
                    })
                    .collect(),
            },
            AnalogTrace {
                name: "LED 0 level".into(),
                unit: "".into(),
                steps: true,
                points: vec![(0, 0.0), (us(19_000.0), 0.8), (us(500_000.0), 0.4)],
            },
        ],
        windows: Timeline::windows_around(&triggers, us(40.0), us(260.0)),
    };
    let mut many = timeline.clone();
    many.title = "Many windows".into();
    let all: Vec<u64> = (0..20).map(|i| us(10_000.0 + 30_000.0 * f64::from(i))).collect();
    many.windows = Timeline::windows_around(&all, us(40.0), us(260.0));
    many.lines.truncate(2);
    Ok(Section {
        title: "Timing".into(),
        figures: vec![
            figure(
                "timing",
                "Timing.",
                "Strobes of microseconds beside moves of milliseconds.",
                timeline.render_svg()?,
            ),
            figure("many", "Timing.", "More windows than are drawn.", many.render_svg()?),
        ],
        ..Section::default()
    })
}

fn surfaces() -> Result<Section, Box<dyn Error>> {
    let values = cylinder(160, 110);
    let surface = HeightSurface {
        title: "Height of the specimen".into(),
        width: 160,
        height: 110,
        scale: ColourScale::values(&values),
        values,
        axes: GridAxes { x0: -9.2, dx: 0.115, y0: -6.3, dy: 0.115, unit: "mm".into(), names: ["x", "y"] },
        quantity: "h".into(),
        unit: "mm".into(),
    };
    Ok(Section {
        title: "Surface".into(),
        figures: vec![
            figure(
                "scene",
                "Turn it.",
                "Drag to turn, wheel to zoom, double click to reset.",
                surface.render_html()?,
            ),
            figure("still", "Still.", "For print.", surface.render_svg()?),
        ],
        ..Section::default()
    })
}
