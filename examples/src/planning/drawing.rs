//! The common parts of all pictures: colours, the lines of a tree, bodies along a path, and the panels of figures.

use std::{fs, io, iter, path::Path};

use plotters::{
    chart::ChartContext,
    coord::{
        Shift,
        ranged1d::{Ranged, ValueFormatter},
    },
    prelude::{
        Cartesian2d, DrawingArea, DrawingAreaErrorKind, IntoDrawingArea, PathElement, RGBColor,
        SVGBackend, Text,
    },
    style::{
        Color, IntoFont, TextStyle, WHITE,
        text_anchor::{HPos, Pos, VPos},
    },
};

use super::{error::PlanningError, options::Source, rrt::Tree};

/// A part of a picture. Pictures have a large scale because positions on them are integers.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// An error of the drawing library.
pub type DrawingError = DrawingAreaErrorKind<io::Error>;

/// Text, walls and axes.
pub const DARK: RGBColor = RGBColor(38, 43, 56);
/// The colour of things that only serve orientation.
pub const PALE: RGBColor = RGBColor(222, 226, 232);
/// The trees from the start and from the goal.
pub const TREES: [RGBColor; 2] = [WORKERS[0], WORKERS[1]];

/// The colours of workers, used cyclically: those of the server's page.
pub const WORKERS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(22, 168, 121),
    RGBColor(197, 119, 167),
    RGBColor(235, 163, 5),
    RGBColor(142, 193, 241),
    RGBColor(122, 42, 106),
    RGBColor(36, 36, 44),
];

/// The colour of a source.
pub fn ink(source: Source) -> RGBColor {
    match source {
        Source::Brute => RGBColor(120, 127, 140),
        Source::Scan => RGBColor(201, 160, 34),
        Source::Memory | Source::All => RGBColor(35, 138, 92),
        Source::Remote => RGBColor(190, 62, 72),
        Source::Shared => RGBColor(110, 84, 178),
    }
}

/// Draws the axes and the grid of a panel of figures, with about the given number of labels on each axis. `x` and `y`
/// format the labels.
pub fn axes<X, Y>(
    chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
    labels: (usize, usize),
    x_name: &str,
    x: &dyn Fn(&f64) -> String,
    y: &dyn Fn(&f64) -> String,
) -> Result<(), DrawingError>
where
    X: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let small = letters(FONT_SIZES[1], DARK);
    chart
        .configure_mesh()
        .bold_line_style(PALE.stroke_width(2))
        .light_line_style(PALE.mix(0.0))
        .axis_style(DARK.stroke_width(3))
        .x_labels(labels.0)
        .y_labels(labels.1)
        .label_style(small.clone())
        .axis_desc_style(small)
        .x_desc(x_name)
        .x_label_formatter(x)
        .y_label_formatter(y)
        .draw()
}

/// The colour along a path, from light to dark, for `share` from 0 to 1.
pub fn along(share: f64) -> RGBColor {
    const LIGHT: [f64; 3] = [250.0, 205.0, 226.0];
    const DEEP: [f64; 3] = [112.0, 16.0, 92.0];
    let share = share.clamp(0.0, 1.0);
    let mix = |i: usize| (LIGHT[i] + share * (DEEP[i] - LIGHT[i])).round() as u8;
    RGBColor(mix(0), mix(1), mix(2))
}

/// Draws a picture of this size and writes it to `path`.
pub fn picture(
    path: &Path,
    size: (u32, u32),
    draw: impl FnOnce(&Area<'_>) -> Result<(), DrawingError>,
) -> Result<(), PlanningError> {
    let failed = |problem: String| PlanningError::File {
        path: path.to_owned(),
        problem,
    };
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, size).into_drawing_area();
        let drawn = area.fill(&WHITE).and_then(|()| draw(&area));
        let drawn = drawn.and_then(|()| area.present());
        drawn.map_err(|error| failed(error.to_string()))?;
    }
    fs::write(path, text).map_err(|error| failed(error.to_string()))?;
    println!("{} is drawn.", path.display());
    Ok(())
}

/// The font sizes: of titles, and of other text.
pub const FONT_SIZES: [i32; 2] = [46, 34];

/// A text style.
pub fn letters(size: i32, color: RGBColor) -> TextStyle<'static> {
    let place = Pos::new(HPos::Left, VPos::Center);
    ("sans-serif", size).into_font().color(&color).pos(place)
}

/// Writes text at a position in the area.
pub fn write(
    area: &Area<'_>,
    text: impl Into<String>,
    place: (i32, i32),
    style: TextStyle<'static>,
) -> Result<(), DrawingError> {
    area.draw(&Text::new(text.into(), place, style))
}

/// A legend in one line: each text follows a stroke of its colour. `spacing` is the distance between their beginnings.
pub fn legend(
    area: &Area<'_>,
    entries: &[(&str, RGBColor)],
    (mut x, y): (i32, i32),
    spacing: i32,
) -> Result<(), DrawingError> {
    for (text, color) in entries {
        let line = vec![(x, y), (x + 50, y)];
        area.draw(&PathElement::new(line, color.stroke_width(10)))?;
        write(area, *text, (x + 66, y), letters(FONT_SIZES[1], DARK))?;
        x += spacing;
    }
    Ok(())
}

/// A tree as one line that follows each edge forth and back. This gives the smallest file, and an edge that is followed
/// twice is not darker. Nodes in the middle of a straight part are left out.
pub fn walk(tree: &Tree, project: impl Fn(&[f64]) -> (f64, f64)) -> Vec<(f64, f64)> {
    let mut children = vec![Vec::new(); tree.len()];
    for (node, parent) in tree.parents.iter().enumerate() {
        if let Some(parent) = *parent {
            children[parent].push(node);
        }
    }
    let root = (!children.is_empty()).then_some(0);
    let nodes = iter::successors(root, |&node| children[node].pop().or(tree.parents[node]));
    straightened(nodes.map(|node| project(tree.states.row(node))))
}

/// A tree as lines through nodes, each in one colour: the colour of all its nodes except the first, from which the line
/// branches off. In `order`, parents come before their children.
pub fn lines<C: Copy + PartialEq>(
    order: impl Iterator<Item = usize>,
    parents: &[Option<usize>],
    color: impl Fn(usize) -> C,
) -> Vec<(C, Vec<usize>)> {
    let mut lines: Vec<(C, Vec<usize>)> = Vec::new();
    // The line that ends at each node.
    let mut ends: Vec<Option<usize>> = vec![None; parents.len()];
    for node in order {
        let Some(parent) = parents[node] else {
            continue;
        };
        let color = color(node);
        let line = ends[parent].filter(|&line| lines[line].0 == color);
        if let Some(line) = line {
            lines[line].1.push(node);
            ends[parent] = None;
            ends[node] = Some(line);
        } else {
            ends[node] = Some(lines.len());
            lines.push((color, vec![parent, node]));
        }
    }
    lines
}

/// A line without the points in the middle of its straight parts.
pub fn straightened(points: impl Iterator<Item = (f64, f64)>) -> Vec<(f64, f64)> {
    let mut line = Vec::new();
    for place in points {
        if is_straight(&line, place) {
            line.pop();
        }
        line.push(place);
    }
    line
}

/// A mix of a colour and white.
pub fn lighter(color: RGBColor, share: f64) -> RGBColor {
    let mix = |part: u8| (255.0 - share * (255.0 - f64::from(part))).round() as u8;
    RGBColor(mix(color.0), mix(color.1), mix(color.2))
}

/// True if a line visibly goes straight on to `end`.
fn is_straight(line: &[(f64, f64)], end: (f64, f64)) -> bool {
    let [.., a, b] = line else { return false };
    let (before, after) = ((b.0 - a.0, b.1 - a.1), (end.0 - b.0, end.1 - b.1));
    let cross = before.0 * after.1 - before.1 * after.0;
    let dot = before.0 * after.0 + before.1 * after.1;
    dot > 0.0 && cross.abs() < 1e-6 * dot
}

/// A line whose second coordinate is on a circle from `-half` to `half`. It is cut where it crosses the seam, so that
/// it leaves on one side and returns on the other.
pub fn around(line: &[(f64, f64)], half: f64) -> Vec<Vec<(f64, f64)>> {
    let mut parts = vec![Vec::from_iter(line.first().copied())];
    for pair in line.windows(2) {
        let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
        if (y1 - y0).abs() > half {
            let side = half.copysign(y0);
            let beyond = y1 + 2.0 * side;
            let x = x0 + (x1 - x0) * (side - y0) / (beyond - y0);
            if let Some(part) = parts.last_mut() {
                part.push((x, side));
            }
            parts.push(vec![(x, -side)]);
        }
        if let Some(part) = parts.last_mut() {
            part.push((x1, y1));
        }
    }
    parts
}
