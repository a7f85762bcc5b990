//! A small writer of SVG: escaped text, rounded coordinates, nothing from outside.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::error::ReportError;

/// Finished SVG or HTML of a figure. Only this crate makes it, with every foreign text escaped, so
/// that it can be put on a page as it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Markup(pub(crate) String);

impl Markup {
    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Text made safe for element content and attribute values of HTML and XML; control characters
/// that XML forbids are replaced by U+FFFD.
#[must_use]
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\t' | '\n' | '\r' => out.push(c),
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// Where text is anchored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Anchor {
    Start,
    Middle,
    End,
}

impl Anchor {
    fn name(self) -> &'static str {
        match self {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        }
    }
}

pub(crate) const TEXT: f64 = 12.0;
pub(crate) const SMALL: f64 = 11.0;
pub(crate) const TITLE: f64 = 14.0;

/// An SVG drawing in the making; coordinates in pixels, y down.
pub(crate) struct Svg {
    width: f64,
    height: f64,
    label: String,
    body: String,
}

impl Svg {
    pub(crate) fn new(width: f64, height: f64, label: &str) -> Self {
        Svg { width, height, label: label.to_string(), body: String::new() }
    }

    pub(crate) fn text(&mut self, x: f64, y: f64, size: f64, anchor: Anchor, text: &str) {
        let anchor = anchor.name();
        self.push(format_args!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{size}\" text-anchor=\"{anchor}\">{}</text>",
            escape(text)
        ));
    }

    pub(crate) fn title(&mut self, text: &str) {
        self.push(format_args!(
            "<text x=\"8\" y=\"18\" font-size=\"{TITLE}\" font-weight=\"600\">{}</text>",
            escape(text)
        ));
    }

    /// Text running upwards, centred on (x, y).
    pub(crate) fn text_up(&mut self, x: f64, y: f64, size: f64, text: &str) {
        self.push(format_args!(
            "<text transform=\"translate({x:.1} {y:.1}) rotate(-90)\" font-size=\"{size}\" text-anchor=\"middle\">{}</text>",
            escape(text)
        ));
    }

    /// Text over a picture: coloured, with a dark rim that keeps it readable on any grey.
    pub(crate) fn text_on_picture(&mut self, x: f64, y: f64, anchor: Anchor, colour: &str, text: &str) {
        let anchor = anchor.name();
        self.push(format_args!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{TEXT}\" font-weight=\"600\" text-anchor=\"{anchor}\" fill=\"{colour}\" stroke=\"#000\" stroke-width=\"3\" stroke-linejoin=\"round\" paint-order=\"stroke\">{}</text>",
            escape(text)
        ));
    }

    pub(crate) fn line(&mut self, from: (f64, f64), to: (f64, f64), style: &str) {
        self.push(format_args!(
            "<line x1=\"{:.2}\" y1=\"{:.2}\" x2=\"{:.2}\" y2=\"{:.2}\" {style}/>",
            from.0, from.1, to.0, to.1
        ));
    }

    pub(crate) fn rect(&mut self, x: f64, y: f64, w: f64, h: f64, style: &str) {
        self.push(format_args!(
            "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"{w:.2}\" height=\"{h:.2}\" {style}/>"
        ));
    }

    pub(crate) fn circle(&mut self, x: f64, y: f64, r: f64, style: &str) {
        self.push(format_args!("<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"{r}\" {style}/>"));
    }

    /// A path through points; `closed` joins the last to the first.
    pub(crate) fn path(&mut self, points: &[(f64, f64)], closed: bool, style: &str) {
        if points.is_empty() {
            return;
        }
        let mut d = String::new();
        for (i, (x, y)) in points.iter().enumerate() {
            let _ = write!(d, "{}{x:.2} {y:.2}", if i == 0 { 'M' } else { 'L' });
        }
        if closed {
            d.push('Z');
        }
        self.push(format_args!("<path d=\"{d}\" {style}/>"));
    }

    /// A PNG picture; `sharp` keeps enlarged pixels square.
    pub(crate) fn picture(&mut self, x: f64, y: f64, w: f64, h: f64, png: &[u8], sharp: bool) {
        let sharp = if sharp { " style=\"image-rendering:pixelated\"" } else { "" };
        self.push(format_args!(
            "<image x=\"{x:.2}\" y=\"{y:.2}\" width=\"{w:.2}\" height=\"{h:.2}\" preserveAspectRatio=\"none\"{sharp} href=\"data:image/png;base64,{}\"/>",
            STANDARD.encode(png)
        ));
    }

    fn push(&mut self, element: std::fmt::Arguments<'_>) {
        let _ = self.body.write_fmt(element);
        self.body.push('\n');
    }

    pub(crate) fn finish(self) -> Markup {
        let Svg { width, height, label, body } = self;
        Markup(format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" viewBox=\"0 0 {width:.0} {height:.0}\" role=\"img\" aria-label=\"{}\" font-family=\"system-ui, 'DejaVu Sans', Arial, sans-serif\" fill=\"currentColor\">\n{body}</svg>",
            escape(&label)
        ))
    }
}

/// Encodes red, green, blue, opacity as PNG.
pub(crate) fn encode_png(
    figure: &str,
    width: usize,
    height: usize,
    rgba: Vec<u8>,
) -> Result<Vec<u8>, ReportError> {
    let picture = |reason: String| ReportError::Picture { figure: figure.to_string(), reason };
    let size = |n: usize| u32::try_from(n).map_err(|_| picture(format!("{n} pixels on one side")));
    let image = image::RgbaImage::from_raw(size(width)?, size(height)?, rgba)
        .ok_or_else(|| picture("pixels and size differ".into()))?;
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png).map_err(|e| picture(e.to_string()))?;
    Ok(bytes.into_inner())
}
