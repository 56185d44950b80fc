//! Parts of charts: the frame, grids, lines, legends, and texts that show up under the pointer.

use std::fmt::Write;

use super::{axis::Scale, escape::Escaped};

pub(super) const WIDTH: f64 = 960.0;
pub(super) const HEIGHT: f64 = 300.0;
/// The borders around the area of a chart.
pub(super) const LEFT: f64 = 68.0;
pub(super) const RIGHT: f64 = 942.0;
pub(super) const TOP: f64 = 22.0;
pub(super) const BOTTOM: f64 = 262.0;

/// A chart that grows. Writing into it cannot fail.
pub(super) struct Chart(String);

impl Chart {
    /// An empty chart; the label is for readers who do not see it.
    pub(super) fn new(label: &str) -> Chart {
        Chart(format!(
            "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">\n",
            Escaped(label)
        ))
    }

    pub(super) fn end(mut self) -> String {
        self.0.push_str("</svg>\n");
        self.0
    }

    pub(super) fn line(&mut self, class: &str, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        let _ = writeln!(
            self.0,
            "<line class=\"{class}\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>"
        );
    }

    /// A text; the class sets its anchor.
    pub(super) fn text(&mut self, class: &str, x: f64, y: f64, text: &str) {
        let text = Escaped(text);
        let _ = writeln!(
            self.0,
            "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\">{text}</text>"
        );
    }

    /// Lines across the area at the ticks of a vertical scale, with their values.
    pub(super) fn rows(&mut self, scale: &Scale, count: usize, name: impl Fn(f64) -> String) {
        for tick in scale.ticks(count) {
            let y = scale.at(tick);
            self.line("grid", [LEFT, y], [RIGHT, y]);
            self.text("tick end", LEFT - 8.0, y + 4.0, &name(tick));
        }
    }

    /// The values of a horizontal scale below the area.
    pub(super) fn columns(&mut self, scale: &Scale, count: usize, name: impl Fn(f64) -> String) {
        self.line("axis", [LEFT, BOTTOM], [RIGHT, BOTTOM]);
        for tick in scale.ticks(count) {
            let x = scale.at(tick);
            self.line("axis", [x, BOTTOM], [x, BOTTOM + 5.0]);
            self.text("tick middle", x, BOTTOM + 20.0, &name(tick));
        }
    }

    /// A line through points; without points there is none, and a single one is a dot.
    pub(super) fn curve(&mut self, class: &str, points: &[[f64; 2]]) {
        match points {
            [] => {}
            [[x, y]] => {
                let _ = writeln!(
                    self.0,
                    "<circle class=\"dot {class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\"/>"
                );
            }
            points => {
                let _ = writeln!(
                    self.0,
                    "<path class=\"curve {class}\" d=\"{}\"/>",
                    path(points)
                );
            }
        }
    }

    /// A filled area.
    pub(super) fn area(&mut self, class: &str, points: &[[f64; 2]]) {
        if !points.is_empty() {
            let _ = writeln!(
                self.0,
                "<path class=\"area {class}\" d=\"{}Z\"/>",
                path(points)
            );
        }
    }

    /// A column of the area that shows lines of text under the pointer.
    pub(super) fn hover(&mut self, from: f64, to: f64, text: &str) {
        let (width, height, text) = ((to - from).max(1.0), BOTTOM - TOP, Escaped(text));
        let _ = writeln!(
            self.0,
            "<rect class=\"hover\" x=\"{from:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{height}\"><title>{text}</title></rect>"
        );
    }
}

fn path(points: &[[f64; 2]]) -> String {
    let mut path = String::new();
    for (i, [x, y]) in points.iter().enumerate() {
        let letter = if i == 0 { 'M' } else { 'L' };
        let _ = write!(path, "{letter}{x:.1} {y:.1}");
    }
    path
}

/// The names of the series of a chart, each with its colour.
pub(super) fn legend(series: &[(&str, &str)]) -> String {
    let mut legend = String::from("<ul class=\"legend\">\n");
    for (class, name) in series {
        let name = Escaped(name);
        let _ = writeln!(legend, "<li><span class=\"key {class}\"></span>{name}</li>");
    }
    legend.push_str("</ul>\n");
    legend
}
