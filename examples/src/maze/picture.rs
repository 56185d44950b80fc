//! The picture of the maze.

use std::{f64::consts::PI, path::Path};

use plotters::{
    chart::{ChartBuilder, ChartContext},
    coord::types::RangedCoordf64,
    prelude::{Cartesian2d, PathElement, Polygon, Rectangle, SVGBackend},
    style::{Color, WHITE},
};

use super::scene::Maze;
use crate::planning::{
    comparison::Comparison,
    drawing::{
        self, Area, DARK, DrawingError, FONT_SIZES, PALE, TREES, along, around, letters, walk,
        write,
    },
    error::PlanningError,
    panels, path,
    problem::Problem,
};

/// The number of bodies drawn along the path.
const BODIES: usize = 80;

/// Draws the maze with both trees and the path, their side view, and the panels of figures.
pub fn draw(
    maze: &Maze,
    comparison: &Comparison,
    shown: &[Vec<f64>],
    file: &Path,
) -> Result<(), PlanningError> {
    drawing::picture(file, (3300, 2300), |area| {
        let (left, right) = area.split_horizontally(2300);
        let (from_above, from_the_side) = left.split_vertically(1630);
        above(maze, comparison, shown, &from_above)?;
        side(maze, comparison, shown, &from_the_side)?;
        panels::draw(&right.margin(80, 60, 20, 40), comparison)
    })
}

fn above(
    maze: &Maze,
    comparison: &Comparison,
    shown: &[Vec<f64>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let mut chart = plan(maze, area)?;
    for (tree, color) in comparison.solution.trees.iter().zip(TREES) {
        let line = walk(tree, |state| (state[0], state[1]));
        chart.draw_series([PathElement::new(line, color.mix(0.75).stroke_width(3))])?;
    }
    walls(maze, &mut chart)?;
    bodies(maze, shown, BODIES, &mut chart)?;
    let nodes = comparison.solution.nodes();
    let title = format!("A C-shaped body through a maze: {nodes} nodes in R² × S¹");
    write(area, title, (80, 60), letters(FONT_SIZES[0], DARK))?;
    let entries = [
        ("tree from the start", TREES[0]),
        ("tree from the goal", TREES[1]),
    ];
    drawing::legend(area, &entries, (1420, 60), 420)
}

/// An area in which things are drawn by their coordinates.
pub type Plane<'a> = ChartContext<'a, SVGBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// The maze's plane, below a title.
pub fn plan<'a>(maze: &Maze, area: &Area<'a>) -> Result<Plane<'a>, DrawingError> {
    let [width, height] = [0, 1].map(|axis| maze.bounds()[axis].1);
    ChartBuilder::on(area)
        .margin(60)
        .margin_top(110)
        .build_cartesian_2d(-0.1..width + 0.1, -0.1..height + 0.1)
}

/// Draws the walls.
pub fn walls(maze: &Maze, chart: &mut Plane<'_>) -> Result<(), DrawingError> {
    let walls = maze.walls().iter().map(|wall| {
        let (low, high) = (wall.center - wall.half, wall.center + wall.half);
        Rectangle::new([(low.x, low.y), (high.x, high.y)], DARK.filled())
    });
    chart.draw_series(walls)?;
    Ok(())
}

/// Draws `count` bodies along a path.
pub fn bodies(
    maze: &Maze,
    shown: &[Vec<f64>],
    count: usize,
    chart: &mut Plane<'_>,
) -> Result<(), DrawingError> {
    let bodies = path::spread(maze, shown, count);
    let last = bodies.len().saturating_sub(1).max(1) as f64;
    for (at, state) in bodies.iter().enumerate() {
        let outline = maze.outline(state);
        let fill = along(at as f64 / last).mix(0.72).filled();
        chart.draw_series([Polygon::new(outline.clone(), fill)])?;
        let closed = outline.iter().chain(outline.first()).copied();
        let edge = WHITE.mix(0.8).stroke_width(3);
        chart.draw_series([PathElement::new(closed.collect::<Vec<_>>(), edge)])?;
    }
    Ok(())
}

/// The side view: the angle over the same horizontal position.
fn side(
    maze: &Maze,
    comparison: &Comparison,
    shown: &[Vec<f64>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let mut chart = elevation(maze, area)?;
    for (tree, color) in comparison.solution.trees.iter().zip(TREES) {
        let line = walk(tree, |state| (state[0], state[2]));
        let parts = around(&line, PI).into_iter();
        let style = color.mix(0.35).stroke_width(2);
        chart.draw_series(parts.map(|part| PathElement::new(part, style)))?;
    }
    along_path(maze, shown, &mut chart)?;
    let title = "The same trees and path from the side: the body's angle, whose upper and lower edge are one";
    write(area, title, (80, 45), letters(FONT_SIZES[1], DARK))
}

/// The angle over the maze's width, below a title.
pub fn elevation<'a>(maze: &Maze, area: &Area<'a>) -> Result<Plane<'a>, DrawingError> {
    let width = maze.bounds()[0].1;
    let mut chart = ChartBuilder::on(area)
        .margin_left(60)
        .margin_right(60)
        .margin_top(90)
        .margin_bottom(50)
        .build_cartesian_2d(-0.1..width + 0.1, -PI..PI)?;
    for angle in [-PI, -PI / 2.0, 0.0, PI / 2.0, PI] {
        let line = vec![(0.0, angle), (width, angle)];
        chart.draw_series([PathElement::new(line, PALE.stroke_width(3))])?;
    }
    for (name, y) in [("π", 0), ("0", 1), ("−π", 2)] {
        let (_, height) = area.dim_in_pixel();
        let y = 90 + y * (height as i32 - 140) / 2;
        write(area, name, (16, y), letters(FONT_SIZES[1], DARK))?;
    }
    Ok(chart)
}

/// Draws a path over the width: first the light border, then the dark line.
pub fn along_path(
    maze: &Maze,
    shown: &[Vec<f64>],
    chart: &mut Plane<'_>,
) -> Result<(), DrawingError> {
    let states = path::spread(maze, shown, 1000);
    let last = states.len().saturating_sub(1).max(1) as f64;
    // The whole light border is drawn before the line inside it.
    for width in [18, 11] {
        for (at, part) in states.windows(3).enumerate() {
            let line: Vec<(f64, f64)> = part.iter().map(|state| (state[0], state[2])).collect();
            let style = match width {
                11 => along(at as f64 / last).stroke_width(width),
                _ => WHITE.stroke_width(width),
            };
            let parts = around(&line, PI).into_iter();
            chart.draw_series(parts.map(|part| PathElement::new(part, style)))?;
        }
    }
    Ok(())
}
