//! A stack of planes that can be scrolled through on the page.

use base64::Engine as _;

use crate::error::ReportError;
use crate::svg::{Markup, encode_png, escape};

/// Grey planes of equal size, one above the other.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageStack {
    /// Title above the picture.
    pub title: String,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values, `values[(k * height + j) * width + i]`.
    pub values: Vec<f32>,
    /// Name of each plane: "z = −5 µm".
    pub labels: Vec<String>,
    /// Value drawn white; 0 is black.
    pub white: f32,
}

/// Longest side of a plane on the page; larger ones are thinned out.
const MOST_PIXELS: usize = 512;
const SCRIPT: &str = include_str!("stack.js");

impl ImageStack {
    /// One plane with the label and a slider below it. Without scripts the middle plane stands alone.
    ///
    /// # Errors
    /// [`ReportError::Shape`], [`ReportError::Picture`].
    pub fn render_html(&self) -> Result<Markup, ReportError> {
        let size = self.width * self.height;
        if size == 0 || self.labels.is_empty() || self.values.len() != size * self.labels.len() {
            return Err(ReportError::Shape {
                figure: self.title.clone(),
                width: self.width,
                height: self.height,
                values: self.values.len(),
            });
        }
        let step = self.width.max(self.height).div_ceil(MOST_PIXELS);
        let (width, height) = (self.width.div_ceil(step), self.height.div_ceil(step));
        let mut pictures = Vec::new();
        for plane in self.values.chunks_exact(size) {
            let mut rgba = Vec::with_capacity(4 * width * height);
            for y in (0..self.height).step_by(step) {
                for x in (0..self.width).step_by(step) {
                    let v = (255.0 * plane[y * self.width + x] / self.white).clamp(0.0, 255.0) as u8;
                    rgba.extend([v, v, v, 255]);
                }
            }
            let png = encode_png(&self.title, width, height, rgba)?;
            pictures.push(format!(
                "data:image/png;base64,{}",
                base64::engine::general_purpose::STANDARD.encode(png)
            ));
        }
        let middle = pictures.len() / 2;
        let data = serde_json::json!({ "planes": pictures, "labels": self.labels });
        let data = data.to_string().replace('<', "\\u003c");
        Ok(Markup(format!(
            "<div class=\"stack\"><p>{}: <span class=\"plane\">{}</span></p>\n<img alt=\"{}\" src=\"{}\" style=\"image-rendering:pixelated;width:min(100%,{}px)\"><br>\n<input type=\"range\" min=\"0\" max=\"{}\" value=\"{middle}\" aria-label=\"plane\" style=\"width:min(100%,512px);margin:0;box-sizing:border-box\">\n<script type=\"application/json\">{data}</script>\n<script>{SCRIPT}</script></div>",
            escape(&self.title),
            escape(&self.labels[middle]),
            escape(&self.title),
            pictures[middle],
            width.max(384),
            pictures.len() - 1,
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stack_has_its_planes_and_asks_nobody() {
        let mut stack = ImageStack {
            title: "a <stack>".into(),
            width: 2,
            height: 3,
            values: (0..12).map(|v| v as f32).collect(),
            labels: vec!["z = 0".into(), "z = 1 </script>".into()],
            white: 11.0,
        };
        let html = stack.render_html().unwrap();
        assert_eq!(html.as_str().matches("data:image/png").count(), 3);
        assert!(!html.as_str().contains("<stack>"));
        assert_eq!(html.as_str().matches("</script>").count(), 2);
        for word in ["http", "fetch(", "import", "eval"] {
            assert!(!SCRIPT.contains(word));
        }
        stack.values.pop();
        assert!(matches!(stack.render_html(), Err(ReportError::Shape { .. })));
    }
}
