//! Figures from outside: well-formed, self-contained, with the pixels that belong there.

use base64::Engine as _;
use daic_report::{
    AnalogTrace, Cell, Chart, ColourMap, ColourScale, DigitalLine, Figure, GridAxes, Heatmap, HeightSurface,
    Limits, Mark, Overlay, Report, ReportError, Section, Series, SeriesStyle, TableBlock, Timeline, Verdict,
};

const HOSTILE: &str = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)>&\u{0}\u{1b}]]>-->";

fn axes() -> GridAxes {
    GridAxes { x0: 1.0, dx: 0.5, y0: -2.0, dy: 0.5, unit: HOSTILE.into(), names: ["x", "y"] }
}

fn heatmap(width: usize, height: usize, values: Vec<f64>) -> Heatmap {
    Heatmap {
        title: HOSTILE.into(),
        width,
        height,
        values,
        axes: axes(),
        quantity: HOSTILE.into(),
        unit: HOSTILE.into(),
        scale: ColourScale { map: ColourMap::Viridis, limits: Limits::fixed(0.0, 5.0) },
    }
}

fn surface() -> HeightSurface {
    HeightSurface {
        title: HOSTILE.into(),
        width: 3,
        height: 3,
        values: vec![0.0, 1.0, 2.0, f64::NAN, 4.0, 5.0, 6.0, 7.0, 8.0],
        axes: axes(),
        quantity: HOSTILE.into(),
        unit: HOSTILE.into(),
        scale: ColourScale::values(&[0.0, 8.0]),
    }
}

fn overlay(width: usize, height: usize, grey: Vec<u16>) -> Overlay {
    Overlay {
        title: HOSTILE.into(),
        width,
        height,
        grey,
        display: Some((0, 255)),
        marks: vec![
            Mark::rectangle(1.0, 1.0, 4.0, 4.0, HOSTILE, 0),
            Mark::Cross { x: 2.0, y: 3.0, label: HOSTILE.into(), colour: 1 },
            Mark::Cross { x: f64::NAN, y: 3.0, label: HOSTILE.into(), colour: 1 },
            Mark::Dots { points: vec![(1.0, 1.0), (f64::INFINITY, 2.0)], colour: 2 },
        ],
        most_pixels: 900,
    }
}

fn chart() -> Chart {
    Chart {
        title: HOSTILE.into(),
        x_label: HOSTILE.into(),
        y_label: HOSTILE.into(),
        series: vec![
            Series {
                sigma: vec![0.1, 0.1, 0.1],
                ..Series::new(HOSTILE, SeriesStyle::Line, vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)])
            },
            Series::new(HOSTILE, SeriesStyle::Bars, vec![(0.0, 1.0), (1.0, 2.0)]),
            Series::new(HOSTILE, SeriesStyle::Points, vec![(0.5, 1.0)]),
        ],
        y_limits: Some((0.0, 2.0)),
    }
}

fn timeline() -> Timeline {
    Timeline {
        title: HOSTILE.into(),
        tick_hz: 125e6,
        lines: vec![DigitalLine {
            name: HOSTILE.into(),
            initial: true,
            edges: vec![(10, false), (1000, true), (1_000_000, false)],
        }],
        traces: vec![AnalogTrace {
            name: HOSTILE.into(),
            unit: HOSTILE.into(),
            points: vec![(0, 0.0), (500_000, 1.0)],
            steps: false,
        }],
        windows: Timeline::windows_around(&[1000, 1_000_000], 500, 2000),
    }
}

/// Checks nesting, quoting and entities of the markup as strictly as XML would, and that nothing
/// is fetched from elsewhere. Returns the texts between the tags.
fn check_xml(markup: &str) -> Vec<String> {
    let mut open: Vec<String> = Vec::new();
    let mut texts = Vec::new();
    let mut rest = markup;
    assert!(markup.chars().all(|c| !c.is_control() || c == '\n'), "control character");
    while let Some(at) = rest.find('<') {
        let text = &rest[..at];
        assert!(!text.contains('>'), "stray > in {text:?}");
        check_entities(text);
        texts.push(text.to_string());
        let end = rest[at..].find('>').expect("tag is closed") + at;
        let tag = &rest[at + 1..end];
        rest = &rest[end + 1..];
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(name), "nesting");
            continue;
        }
        let (tag, empty) = tag.strip_suffix('/').map_or((tag, false), |t| (t, true));
        let (name, attributes) = tag.split_once(' ').unwrap_or((tag, ""));
        assert!(name.bytes().all(|b| b.is_ascii_alphanumeric()) && !name.is_empty(), "tag {name:?}");
        assert!(
            ["svg", "g", "text", "line", "rect", "circle", "path", "image"].contains(&name),
            "unexpected element {name}"
        );
        // Attributes are name="value" with nothing between but spaces.
        for (i, piece) in attributes.split('"').enumerate() {
            if i % 2 == 0 {
                let name = piece.trim();
                let plain = |b: u8| b.is_ascii_alphanumeric() || b"-:=".contains(&b);
                assert!(name.is_empty() || (name.ends_with('=') && name.bytes().all(plain)), "{piece:?}");
                assert!(!name.starts_with("on"), "event handler {name}");
                if name == "href=" {
                    let value = attributes.split('"').nth(i + 1).unwrap();
                    assert!(value.starts_with("data:image/png;base64,"), "{value:.60}");
                }
            } else {
                check_entities(piece);
            }
        }
        if !empty {
            open.push(name.to_string());
        }
    }
    assert!(open.is_empty(), "not closed: {open:?}");
    texts
}

fn check_entities(text: &str) {
    for (at, _) in text.match_indices('&') {
        let known = ["&amp;", "&lt;", "&gt;", "&quot;", "&#39;"];
        assert!(known.iter().any(|e| text[at..].starts_with(e)), "bare & in {text:?}");
    }
}

fn unescape(text: &str) -> String {
    let text = text.replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"");
    text.replace("&#39;", "'").replace("&amp;", "&")
}

#[test]
fn every_svg_is_well_formed_and_shows_hostile_text_as_text() {
    let shown = HOSTILE.replace(['\u{0}', '\u{1b}'], "\u{fffd}");
    for svg in [
        heatmap(3, 2, vec![0.0, 1.0, f64::NAN, 3.0, 4.0, 5.0]).render_svg().unwrap(),
        overlay(8, 6, (0..48).collect()).render_svg().unwrap(),
        chart().render_svg().unwrap(),
        timeline().render_svg().unwrap(),
        surface().render_svg().unwrap(),
    ] {
        let texts = check_xml(svg.as_str());
        assert!(texts.iter().any(|t| unescape(t).contains(&shown[..20])), "text is shown");
        assert!(!svg.as_str().contains("<script"));
        assert!(!svg.as_str().contains("NaN") && !svg.as_str().contains("inf"));
    }
}

#[test]
fn the_check_itself_finds_faults() {
    for bad in [
        "<svg><text></svg>",
        "<svg><text>a & b</text></svg>",
        "<svg><script></script></svg>",
        "<svg><image href=\"http://x\"/></svg>",
        "<svg><rect onload=\"x\"/></svg>",
    ] {
        assert!(std::panic::catch_unwind(|| check_xml(bad)).is_err(), "{bad}");
    }
}

fn pixels(png: &[u8]) -> image::RgbaImage {
    image::load_from_memory(png).unwrap().to_rgba8()
}

#[test]
fn heatmap_pixels_are_the_colours_of_the_values() {
    let values = vec![0.0, 1.0, f64::NAN, 3.0, 5.0, 99.0];
    let map = heatmap(3, 2, values.clone());
    let picture = pixels(&map.render_png().unwrap());
    let n = picture.width() / 3;
    assert_eq!((picture.width(), picture.height()), (3 * n, 2 * n));
    assert!(n > 1);
    for (at, &v) in values.iter().enumerate() {
        let (i, j) = (at as u32 % 3, at as u32 / 3);
        for (x, y) in [(i * n, j * n), (i * n + n - 1, j * n + n - 1)] {
            let expected = match v {
                v if v.is_nan() => [0, 0, 0, 0],
                v => {
                    let [r, g, b] = ColourMap::Viridis.rgb(v / 5.0);
                    [r, g, b, 255]
                }
            };
            assert_eq!(picture.get_pixel(x, y).0, expected, "{at}");
        }
    }
}

#[test]
fn svg_holds_the_map_node_by_node() {
    let svg = heatmap(3, 2, vec![0.0, 1.0, f64::NAN, 3.0, 5.0, 2.0]).render_svg().unwrap();
    let data = svg.as_str().split("data:image/png;base64,").nth(1).unwrap().split('"').next().unwrap();
    let picture = pixels(&base64::engine::general_purpose::STANDARD.decode(data).unwrap());
    assert_eq!(picture.dimensions(), (3, 2));
    assert_eq!(picture.get_pixel(2, 0).0[3], 0);
    assert_eq!(picture.get_pixel(0, 0).0, [0x44, 0x01, 0x54, 255]);
}

#[test]
fn overlay_averages_areas_and_keeps_black_and_white() {
    // 2000 x 4 in 2 x 2 blocks: the mean of 0, 255, 255, 0 is 127.5, shown 128.
    let checker: Vec<u16> =
        (0..8000u32).map(|i| if (i % 2000 + i / 2000) % 2 == 1 { 255 } else { 0 }).collect();
    let mut frame = overlay(2000, 4, checker);
    frame.most_pixels = 1000;
    let picture = pixels(&frame.render_png().unwrap());
    assert_eq!(picture.dimensions(), (1000, 2));
    assert!(picture.pixels().all(|p| p.0 == [128, 128, 128, 255]));
    let picture = pixels(&overlay(3, 1, vec![0, 255, 999]).render_png().unwrap());
    let greys: Vec<u8> = picture.pixels().map(|p| p.0[0]).collect();
    assert_eq!(greys, [0, 255, 255]);
}

#[test]
fn a_mark_stands_where_its_pixel_is() {
    let mut frame = overlay(100, 50, vec![9; 5000]);
    frame.most_pixels = 200; // zoom 2
    frame.marks = vec![Mark::Dots { points: vec![(0.0, 0.0), (99.0, 49.0)], colour: 0 }];
    let svg = frame.render_svg().unwrap();
    // The picture begins at y = 30; pixel (0, 0) covers 2 x 2 there, its centre is one further.
    assert!(svg.as_str().contains("cx=\"1.00\" cy=\"31.00\""));
    assert!(svg.as_str().contains("cx=\"199.00\" cy=\"129.00\""));
}

#[test]
fn timeline_draws_pulses_at_their_ticks() {
    let mut timeline = timeline();
    timeline.traces.clear();
    timeline.lines =
        vec![DigitalLine { name: "s".into(), initial: false, edges: vec![(1000, true), (1400, false)] }];
    timeline.windows = vec![(0, 3800)];
    let svg = timeline.render_svg().unwrap();
    // 3800 ticks over 760 px, from x = 150: the pulse of 400 ticks is 80 px wide at 350.
    assert!(
        svg.as_str().contains("x=\"350.00\"") && svg.as_str().contains("width=\"80.00\""),
        "{}",
        svg.as_str()
    );
}

#[test]
fn every_window_of_a_timeline_has_labels_in_common_units() {
    // Texts below the rows of the windows, between the edges of each: windows are laid out from
    // x = 150 on with 34 px between them.
    for length_us in [1.0, 3.0, 7.0, 42.0, 210.0, 300.0, 700.0, 1999.0, 2100.0, 4200.0, 9000.0, 420_000.0] {
        for count in 1..=12u32 {
            let mut timeline = timeline();
            timeline.title = "t".into();
            let ticks = (length_us * 125.0) as u64;
            timeline.windows = (0..u64::from(count))
                .map(|i| (225_000 + i * 3 * ticks, 225_000 + i * 3 * ticks + ticks))
                .collect();
            let svg = timeline.render_svg().unwrap();
            let texts = check_xml(svg.as_str());
            let zeros: Vec<usize> = (0..texts.len())
                .filter(|&i| {
                    texts[i].trim_start_matches('0').trim_start_matches('.').trim_matches('0').is_empty()
                })
                .filter(|&i| texts[i].starts_with('0'))
                .collect();
            assert_eq!(zeros.len(), count as usize + 1, "{length_us} µs, {count}: {texts:?}");
            for &zero in &zeros[1..] {
                let next: f64 =
                    texts[zero + 1..].iter().find(|t| !t.trim().is_empty()).unwrap().parse().unwrap_or(0.0);
                assert!(next > 0.0, "{length_us} µs, {count}: one label only: {texts:?}");
            }
            let units: std::collections::BTreeSet<&str> =
                texts.iter().filter(|t| t.contains(" at ")).map(|t| t.rsplit(' ').next().unwrap()).collect();
            assert_eq!(units.len(), 1, "{units:?}");
        }
    }
    let mut two = timeline();
    two.windows = vec![(225_000, 300_000), (61_475_875, 61_550_875)];
    let svg = two.render_svg().unwrap();
    assert!(svg.as_str().contains("1 at 1.800 ms") && svg.as_str().contains("2 at 491.807 ms"));
}

#[test]
fn wrong_shapes_are_errors() {
    assert!(matches!(heatmap(3, 2, vec![0.0; 5]).render_svg(), Err(ReportError::Shape { .. })));
    assert!(matches!(heatmap(0, 0, vec![]).render_png(), Err(ReportError::Shape { .. })));
    assert!(matches!(heatmap(usize::MAX, 2, vec![0.0; 5]).render_png(), Err(ReportError::Shape { .. })));
    let mut flat = heatmap(1, 1, vec![1.0]);
    flat.axes.dx = 0.0;
    assert!(matches!(flat.render_svg(), Err(ReportError::Axes { .. })));
    assert!(matches!(overlay(3, 3, vec![0; 8]).render_svg(), Err(ReportError::Shape { .. })));
    let mut empty = surface();
    empty.values = vec![f64::NAN; 9];
    assert!(matches!(empty.render_html(), Err(ReportError::Empty { .. })));
    let mut nothing = timeline();
    (nothing.lines, nothing.traces, nothing.windows) = (vec![], vec![], vec![]);
    assert!(matches!(nothing.render_svg(), Err(ReportError::Empty { .. })));
    // All-NaN maps are drawn: an empty map is an answer too.
    heatmap(2, 2, vec![f64::NAN; 4]).render_svg().unwrap();
}

#[test]
fn the_page_is_self_contained_and_hostile_text_stays_text() {
    let figure = |body| Figure { id: HOSTILE.into(), title: HOSTILE.into(), caption: HOSTILE.into(), body };
    let report = Report {
        title: HOSTILE.into(),
        subtitle: HOSTILE.into(),
        verdict: Some(Verdict { pass: false, text: HOSTILE.into() }),
        sections: vec![Section {
            title: HOSTILE.into(),
            text: vec![HOSTILE.into()],
            tables: vec![TableBlock {
                caption: HOSTILE.into(),
                head: vec![HOSTILE.into()],
                rows: vec![vec![Cell::Text(HOSTILE.into())], vec![Cell::Fail(HOSTILE.into())]],
            }],
            figures: vec![
                figure(surface().render_html().unwrap()),
                figure(heatmap(2, 1, vec![1.0, 2.0]).render_svg().unwrap()),
            ],
        }],
        provenance: vec![(HOSTILE.into(), HOSTILE.into())],
    };
    let page = report.render().unwrap();
    assert_eq!(page.matches("<script").count(), 2, "data and program of the surface, nothing else");
    assert_eq!(page.matches("</script").count(), 2);
    assert!(!page.contains("<img"), "no foreign element");
    for reference in ["href=\"", "src=\"", "url("] {
        for (at, _) in page.match_indices(reference) {
            assert!(page[at + reference.len()..].starts_with("data:image/png"), "{}", &page[at..at + 60]);
        }
    }
    let outside = page.replace("http://www.w3.org/2000/svg", "");
    assert!(!outside.contains("http://") && !outside.contains("https://"));
    assert!(page.contains("✗ Failed."));
    // Two figures of one name get two anchors.
    let ids: Vec<&str> = page
        .match_indices("<figure id=\"")
        .map(|(at, m)| page[at + m.len()..].split('"').next().unwrap())
        .collect();
    assert_eq!(ids.len(), 2);
    assert_ne!(ids[0], ids[1]);
    assert!(ids.iter().all(|id| id.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_".contains(&b))));
}

#[test]
fn the_same_input_gives_the_same_bytes() {
    assert_eq!(surface().render_html().unwrap(), surface().render_html().unwrap());
    assert_eq!(timeline().render_svg().unwrap(), timeline().render_svg().unwrap());
}
