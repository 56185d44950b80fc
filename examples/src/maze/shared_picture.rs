//! The picture of the trees that several workers built together.

use std::path::Path;

use plotters::{
    prelude::{PathElement, RGBColor},
    style::Color,
};

use super::{picture, scene::Maze};
use crate::planning::{
    drawing::{
        self, Area, DARK, DrawingError, FONT_SIZES, WORKERS, letters, lighter, lines, straightened,
        write,
    },
    error::PlanningError,
    shared_trees::solve::SharedSolution,
    worker_panels,
};

/// The number of bodies drawn along the path, small enough that the trees stay visible between them.
const BODIES: usize = 50;

/// The part of a worker's colour in the lines of the tree from the start, and in those of the tree from the goal.
const SHADES: [f64; 2] = [1.0, 0.55];

/// Draws the maze with both trees and the path, and the panels of figures.
pub fn draw(
    maze: &Maze,
    solved: &SharedSolution,
    shown: &[Vec<f64>],
    file: &Path,
) -> Result<(), PlanningError> {
    drawing::picture(file, (2700, 2620), |area| {
        let (above, below) = area.split_vertically(1900);
        trees(maze, solved, shown, &above)?;
        let (left, right) = below.split_horizontally(1400);
        worker_panels::growth(&left, &solved.workers_report, "Vertices")?;
        worker_panels::shares(&right, &solved.workers_report)
    })
}

fn trees(
    maze: &Maze,
    solved: &SharedSolution,
    shown: &[Vec<f64>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let (head, area) = area.split_vertically(100);
    let mut chart = picture::plan(maze, &area)?;
    let shared = &solved.shared;
    // The goal's lines are drawn first, because they are lighter.
    for (at, shade) in SHADES.into_iter().enumerate().rev() {
        let (tree, makers) = (&shared.trees[at], &shared.makers[at]);
        for (worker, nodes) in lines(0..tree.len(), &tree.parents, |node| makers[node]) {
            let places = nodes.iter().map(|&node| {
                let state = tree.states.row(node);
                (state[0], state[1])
            });
            let style = ink(worker, shade).stroke_width(4);
            chart.draw_series([PathElement::new(straightened(places), style)])?;
        }
    }
    picture::walls(maze, &mut chart)?;
    picture::bodies(maze, shown, BODIES, &mut chart)?;

    let workers = solved.workers_report.accounts.len();
    let grown_by = match workers {
        1 => "one process".to_owned(),
        workers => format!("{workers} processes"),
    };
    let title = format!(
        "The same two trees, grown by {grown_by}: {} vertices in R² × S¹",
        shared.len()
    );
    write(&head, title, (80, 60), letters(FONT_SIZES[0], DARK))?;
    legend(&area, workers)
}

/// The colours of the workers, in both shades.
fn legend(area: &Area<'_>, workers: usize) -> Result<(), DrawingError> {
    let mut x = 80;
    for worker in 0..workers.min(WORKERS.len()) {
        for (y, shade) in [38, 54].into_iter().zip(SHADES) {
            let line = vec![(x, y), (x + 60, y)];
            let style = ink(worker, shade).stroke_width(12);
            area.draw(&PathElement::new(line, style))?;
        }
        let name = format!("worker {worker}");
        write(area, name, (x + 76, 46), letters(FONT_SIZES[1], DARK))?;
        x += 260;
    }
    let hint = "dark: the tree from the start; light: the tree from the goal";
    write(area, hint, (x + 20, 46), letters(FONT_SIZES[1], DARK))
}

fn ink(worker: usize, shade: f64) -> RGBColor {
    lighter(WORKERS[worker % WORKERS.len()], shade)
}
