//! The picture of the tree of RRT*.

use std::{f64::consts::PI, path::Path};

use plotters::{
    chart::ChartBuilder,
    prelude::{Circle, ColorMap, PathElement, RGBColor, Rectangle, ViridisRGB},
    style::Color,
};

use super::{picture, scene::Maze};
use crate::planning::{
    drawing::{
        self, Area, DARK, DrawingError, FONT_SIZES, along, around, axes, letters, lines,
        straightened, write,
    },
    error::PlanningError,
    rrt_star::Star,
};

/// The number of bodies drawn along the path, small enough that the tree stays visible between them.
const BODIES: usize = 50;

/// The number of colours that encode the distance of a node from the root.
const BANDS: usize = 64;

/// Draws the maze with the tree and its path, the length of the path over the samples, and the side view of the tree.
pub fn draw(maze: &Maze, star: &Star, path: &[Vec<f64>], file: &Path) -> Result<(), PlanningError> {
    drawing::picture(file, (2700, 2620), |area| {
        let (above, below) = area.split_vertically(1900);
        let tree = BandedTree::of(star);
        from_above(maze, &tree, path, &above)?;
        let (left, right) = below.split_horizontally(1100);
        length(star, &left)?;
        from_the_side(maze, &tree, path, &right)
    })
}

/// A tree in lines of one colour each.
struct BandedTree<'a> {
    star: &'a Star,
    /// The distance of the farthest node.
    farthest: f64,
    lines: Vec<(usize, Vec<usize>)>,
}

impl BandedTree<'_> {
    fn of(star: &Star) -> BandedTree<'_> {
        let costs = &star.tree.costs;
        let farthest = costs.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        // A child is never nearer than its parent.
        let mut order: Vec<usize> = (0..star.tree.len()).collect();
        order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]));
        let band = |node: usize| {
            let share = costs[node] / farthest;
            ((share * BANDS as f64) as usize).min(BANDS - 1)
        };
        let mut lines = lines(order.into_iter(), &star.tree.parents, band);
        // Near lines are drawn over far ones.
        lines.sort_by_key(|(band, _)| std::cmp::Reverse(*band));
        BandedTree {
            star,
            farthest,
            lines,
        }
    }

    /// Its lines, by these two coordinates of the states.
    fn lines(&self, axes: [usize; 2]) -> impl Iterator<Item = (RGBColor, Vec<(f64, f64)>)> {
        self.lines.iter().map(move |(band, nodes)| {
            let places = nodes.iter().map(|&node| {
                let state = self.star.tree.states.row(node);
                (state[axes[0]], state[axes[1]])
            });
            (ink(*band), straightened(places))
        })
    }
}

/// Colours from dark to light, but dark enough to be visible on white.
fn ink(band: usize) -> RGBColor {
    ViridisRGB.get_color(0.93 * band as f64 / BANDS as f64)
}

fn from_above(
    maze: &Maze,
    tree: &BandedTree<'_>,
    path: &[Vec<f64>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let (head, area) = area.split_vertically(100);
    let mut chart = picture::plan(maze, &area)?;
    for (color, line) in tree.lines([0, 1]) {
        chart.draw_series([PathElement::new(line, color.stroke_width(2))])?;
    }
    picture::walls(maze, &mut chart)?;
    picture::bodies(maze, path, BODIES, &mut chart)?;
    let progress = tree.star.progress.last();
    let samples = progress.map_or(0, |progress| progress.samples);
    let title = format!(
        "The tree of RRT* after {samples} samples: {} nodes in R² × S¹, and its path",
        tree.star.tree.len()
    );
    write(&head, title, (80, 60), letters(FONT_SIZES[0], DARK))?;

    let style = || letters(FONT_SIZES[1], DARK);
    write(
        &area,
        "length of the way from the start:",
        (80, 46),
        style(),
    )?;
    write(&area, "0", (600, 46), style())?;
    let (left, width) = (640, 14);
    for band in 0..BANDS {
        let from = left + width * band as i32;
        // Slightly too wide, so that no seam shows.
        let corners = [(from, 28), (from + width + 2, 64)];
        area.draw(&Rectangle::new(corners, ink(band).filled()))?;
    }
    let right = left + width * BANDS as i32;
    let farthest = format!("{:.1}", tree.farthest);
    write(&area, farthest, (right + 20, 46), style())
}

/// Draws the length of the path over the number of samples.
fn length(star: &Star, area: &Area<'_>) -> Result<(), DrawingError> {
    let samples = star.progress.last().map_or(0, |last| last.samples) as f64;
    let (Some(first), Some(last)) = (star.shortened.first(), star.shortened.last()) else {
        return Ok(());
    };
    let rise = (first.1 - last.1).max(0.01 * last.1);
    let mut chart = ChartBuilder::on(area)
        .margin_left(40)
        .margin_right(60)
        .margin_bottom(20)
        .margin_top(120)
        .x_label_area_size(90)
        .y_label_area_size(130)
        .build_cartesian_2d(0.0..samples, last.1 - 0.15 * rise..first.1 + 0.1 * rise)?;
    axes(
        &mut chart,
        (4, 5),
        "samples",
        &|samples| format!("{samples:.0}"),
        &|length| format!("{length:.1}"),
    )?;
    let color = along(1.0);
    // The length stays constant until the path becomes shorter.
    let mut steps: Vec<(f64, f64)> = Vec::new();
    for &(drawn, length) in &star.shortened {
        let drawn = drawn as f64;
        steps.extend(steps.last().map(|&(_, before)| (drawn, before)));
        steps.push((drawn, length));
    }
    steps.push((samples, last.1));
    chart.draw_series([PathElement::new(steps, color.stroke_width(7))])?;
    chart.draw_series([Circle::new((first.0 as f64, first.1), 14, color.filled())])?;
    let title = "Length of the path over samples";
    write(area, title, (80, 56), letters(FONT_SIZES[0], DARK))
}

fn from_the_side(
    maze: &Maze,
    tree: &BandedTree<'_>,
    path: &[Vec<f64>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let mut chart = picture::elevation(maze, area)?;
    for (color, line) in tree.lines([0, 2]) {
        let parts = around(&line, PI).into_iter();
        let style = color.mix(0.5).stroke_width(2);
        chart.draw_series(parts.map(|part| PathElement::new(part, style)))?;
    }
    picture::along_path(maze, path, &mut chart)?;
    let title = "From the side: the body's angle, whose upper and lower edge are one";
    write(area, title, (80, 45), letters(FONT_SIZES[1], DARK))
}
