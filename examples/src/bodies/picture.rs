//! The picture of the room.

use std::path::Path;

use parry3d_f64::math::{Pose, Vector};
use plotters::{
    chart::ChartBuilder,
    prelude::{PathElement, Polygon, RGBColor, Rectangle},
    style::{Color, WHITE},
};

use super::{
    projection::{self, Face, View},
    scene::{self, BODIES, OBSTACLES, ROOM, Room},
};
use crate::planning::{
    comparison::Comparison,
    drawing::{
        self, Area, DARK, DrawingError, FONT_SIZES, PALE, TREES, WORKERS, letters, walk, write,
    },
    error::PlanningError,
    panels, path,
};

/// The number of states along the path at which the bodies are drawn.
const STATES: usize = 22;

/// Draws the room with the path of all bodies, the trees from above and from the side, and the panels of figures.
pub fn draw(
    room: &Room,
    comparison: &Comparison,
    shown: &[Vec<f64>],
    file: &Path,
) -> Result<(), PlanningError> {
    drawing::picture(file, (3300, 2300), |area| {
        let (left, right) = area.split_horizontally(2300);
        let (bodies, trees) = left.split_vertically(1500);
        along_the_path(room, comparison, shown, &bodies)?;
        let (above, side) = trees.split_horizontally(1150);
        flat(
            comparison,
            &above,
            "Both trees, from above: the middles of all bodies",
            1,
        )?;
        flat(comparison, &side, "and from the side", 2)?;
        let entries = [("from the start", TREES[0]), ("from the goal", TREES[1])];
        drawing::legend(&side, &entries, (440, 40), 340)?;
        panels::draw(&right.margin(80, 60, 20, 40), comparison)
    })
}

fn along_the_path(
    room: &Room,
    comparison: &Comparison,
    shown: &[Vec<f64>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let view = View::new(-0.42, 0.5);
    let corners =
        [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| (x * ROOM[0], y * ROOM[1]));
    let at = |x: f64, y: f64, z: f64| view.project(Vector::new(x, y, z));
    let all = corners
        .iter()
        .flat_map(|&(x, y)| [at(x, y, 0.0), at(x, y, ROOM[2])]);
    let (mut low, mut high) = ((f64::MAX, f64::MAX), (f64::MIN, f64::MIN));
    for (x, y) in all {
        low = (low.0.min(x), low.1.min(y));
        high = (high.0.max(x), high.1.max(y));
    }
    // A unit has the same number of pixels in both directions.
    let (width, height) = (2180.0, 1330.0);
    let unit = f64::min(width / (high.0 - low.0), height / (high.1 - low.1));
    let spare = (
        width / unit - (high.0 - low.0),
        height / unit - (high.1 - low.1),
    );
    let mut chart = ChartBuilder::on(area)
        .margin(60)
        .margin_top(110)
        .build_cartesian_2d(
            low.0 - spare.0 / 2.0..high.0 + spare.0 / 2.0,
            low.1 - spare.1 / 2.0..high.1 + spare.1 / 2.0,
        )?;
    let floor: Vec<_> = corners.iter().map(|&(x, y)| at(x, y, 0.0)).collect();
    chart.draw_series([Polygon::new(floor, PALE.mix(0.45).filled())])?;
    let grid = (0..=ROOM[0] as u32)
        .map(f64::from)
        .map(|x| vec![at(x, 0.0, 0.0), at(x, ROOM[1], 0.0)]);
    let across = (0..=ROOM[1] as u32)
        .map(f64::from)
        .map(|y| vec![at(0.0, y, 0.0), at(ROOM[0], y, 0.0)]);
    let lines = grid.chain(across);
    chart.draw_series(lines.map(|line| PathElement::new(line, WHITE.stroke_width(3))))?;
    // The rear edges of the room, behind everything else.
    let back = [(0.0, ROOM[1]), (ROOM[0], ROOM[1]), (ROOM[0], 0.0)];
    let posts = back.map(|(x, y)| vec![at(x, y, 0.0), at(x, y, ROOM[2])]);
    let ceiling = vec![
        at(0.0, ROOM[1], ROOM[2]),
        at(ROOM[0], ROOM[1], ROOM[2]),
        at(ROOM[0], 0.0, ROOM[2]),
    ];
    let edges = posts.into_iter().chain([ceiling]);
    chart.draw_series(edges.map(|line| PathElement::new(line, PALE.stroke_width(4))))?;
    for face in &solids(room, shown, &view) {
        let (color, opacity) = face.color;
        let fill = shaded(color, face.light).mix(opacity).filled();
        chart.draw_series([Polygon::new(face.corners.to_vec(), fill)])?;
        if opacity < 1.0 || color != DARK {
            let round = face.corners.iter().chain(face.corners.first()).copied();
            let edge = shaded(color, 0.6).mix(0.5 * opacity).stroke_width(2);
            chart.draw_series([PathElement::new(round.collect::<Vec<_>>(), edge)])?;
        }
    }
    let nodes = comparison.solution.nodes();
    let title = format!(
        "Eight bodies change places, from light to dark: {nodes} nodes in (R³ × RP³)⁸, 48 degrees of freedom"
    );
    write(area, title, (80, 60), letters(FONT_SIZES[0], DARK))
}

/// Everything in the room, the nearest last.
fn solids(room: &Room, shown: &[Vec<f64>], view: &View) -> Vec<Face<(RGBColor, f64)>> {
    let mut faces = Vec::new();
    for (low, high) in OBSTACLES {
        // A pillar is cut into slices, each of which is entirely in front of or behind a body.
        const SLICES: u32 = 24;
        let height = (high[2] - low[2]) / f64::from(SLICES);
        let half = Vector::new(
            (high[0] - low[0]) / 2.0,
            (high[1] - low[1]) / 2.0,
            height / 2.0,
        );
        for slice in 0..SLICES {
            let bottom = Vector::new(low[0], low[1], low[2] + height * f64::from(slice));
            let pose = Pose::from_translation(bottom + half);
            // Each slice overlaps the next one a little, so that no gap shows.
            let half = half * Vector::new(1.0, 1.0, 1.1);
            projection::faces(view, &pose, half, (DARK, 1.0), &mut faces);
        }
    }
    let states = path::spread(room, shown, STATES);
    let last = states.len().saturating_sub(1).max(1) as f64;
    for (at, state) in states.iter().enumerate() {
        let share = at as f64 / last;
        let is_end = at == 0 || at + 1 == states.len();
        for (pose, ink) in scene::poses(state).iter().zip(WORKERS) {
            let opacity = if is_end { 1.0 } else { 0.35 + 0.3 * share };
            let color = (faded(ink, 0.35 + 0.65 * share), opacity);
            for (part, shape) in scene::parts(0.0) {
                projection::faces(view, &(*pose * part), shape.half_extents, color, &mut faces);
            }
        }
    }
    projection::sort(&mut faces);
    faces
}

/// A mix of a colour and white; `share` is the part of the colour.
fn faded(RGBColor(r, g, b): RGBColor, share: f64) -> RGBColor {
    let mix = |channel: u8| (255.0 - share * (255.0 - f64::from(channel))) as u8;
    RGBColor(mix(r), mix(g), mix(b))
}

fn shaded(RGBColor(r, g, b): RGBColor, light: f64) -> RGBColor {
    let mix = |channel: u8| (light * f64::from(channel)) as u8;
    RGBColor(mix(r), mix(g), mix(b))
}

/// Draws the trees, over the length of the room and its width (axis 1) or height (axis 2).
fn flat(
    comparison: &Comparison,
    area: &Area<'_>,
    title: &str,
    axis: usize,
) -> Result<(), DrawingError> {
    // The same scale for all views.
    let unit = 1020.0 / ROOM[0];
    let (width, height) = area.dim_in_pixel();
    let below = (f64::from(height) - 90.0 - unit * ROOM[axis]).max(0.0) as u32;
    let mut chart = ChartBuilder::on(area)
        .margin_left(60)
        .margin_right(width - 60 - 1020)
        .margin_top(90)
        .margin_bottom(below)
        .build_cartesian_2d(0.0..ROOM[0], 0.0..ROOM[axis])?;
    let room = [(0.0, 0.0), (ROOM[0], ROOM[axis])];
    chart.draw_series([Rectangle::new(room, PALE.mix(0.45).filled())])?;
    for (tree, color) in comparison.solution.trees.iter().zip(TREES) {
        for body in 0..BODIES {
            let line = walk(tree, |state| {
                let place = &state[7 * body..];
                (place[0], place[axis])
            });
            chart.draw_series([PathElement::new(line, color.mix(0.22).stroke_width(2))])?;
        }
    }
    let pillars = OBSTACLES.iter().map(|(low, high)| {
        let corners = [(low[0], low[axis]), (high[0], high[axis])];
        Rectangle::new(
            corners,
            DARK.mix(if axis == 1 { 1.0 } else { 0.35 }).filled(),
        )
    });
    chart.draw_series(pillars)?;
    write(area, title, (80, 40), letters(FONT_SIZES[1], DARK))
}
