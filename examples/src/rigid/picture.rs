//! The picture of the three rooms.

use std::path::Path;

use parry3d_f64::math::Vector;
use plotters::{
    prelude::{Circle, PathElement, Polygon, RGBColor},
    style::{Color, WHITE},
};

use super::{
    build::{Answer, Built},
    roadmap::Roadmap,
    scene::{self, DOOR_WALL, FURNITURE, Rooms, SIDES, WINDOW_WALL},
    solid::{self, DEPTH, Projection, Solid},
};
use crate::planning::{
    body::{self, Block},
    drawing::{self, Area, DARK, DrawingError, FONT_SIZES, PALE, WORKERS, letters, write},
    error::PlanningError,
    path,
    problem::Problem,
    worker_panels,
};

/// The chair's colours at the start and at the goal of each question.
const CHAIRS: [[RGBColor; 2]; 3] = [
    [RGBColor(252, 214, 230), RGBColor(150, 22, 110)],
    [RGBColor(212, 240, 228), RGBColor(10, 110, 86)],
    [RGBColor(255, 232, 186), RGBColor(190, 104, 0)],
];

/// The distance between the chairs along a path, in the metric.
const STRIDE: f64 = 1.05;

/// The number of drawn edges of each milestone: the shortest ones.
const EDGES: usize = 2;

const SIZE: (u32, u32) = (3300, 2640);

/// Draws the rooms with the roadmap and the chair along the paths, and the panels of figures.
pub fn draw(scene: &Rooms, built: &Built, file: &Path) -> Result<(), PlanningError> {
    let shorten = |answer: &Answer| path::shorten(scene, answer.states.clone(), 150, built.seed);
    let paths: Result<Vec<_>, _> = built.paths.iter().map(shorten).collect();
    let paths = paths?;
    drawing::picture(file, SIZE, |area| {
        let (above, below) = area.split_vertically(1940);
        rooms(scene, built, &paths, &above)?;
        let (left, right) = below.split_horizontally(1720);
        worker_panels::growth(&left, &built.workers_report, "Milestones")?;
        worker_panels::shares(&right, &built.workers_report)
    })
}

fn rooms(
    scene: &Rooms,
    built: &Built,
    paths: &[Vec<Vec<f64>>],
    area: &Area<'_>,
) -> Result<(), DrawingError> {
    let (width, height) = area.dim_in_pixel();
    const MARGIN: f64 = 80.0;
    let scale = (f64::from(width) - 2.0 * MARGIN) / (SIDES[0] + DEPTH[0] * SIDES[1]);
    let projection = Projection {
        origin: (MARGIN, f64::from(height) - 60.0),
        scale,
    };
    shell(area, &projection)?;
    edges(&built.roadmap, scene, area, &projection)?;

    let mut solids: Vec<Solid> = Vec::new();
    for (path, [first, last]) in paths.iter().zip(CHAIRS) {
        let count = (path::length(scene, path) / STRIDE).round() as usize;
        let states = path::spread(scene, path, count);
        let end = states.len().saturating_sub(1).max(1) as f64;
        for (at, state) in states.iter().enumerate() {
            let pose = body::pose(state);
            solids.push(Solid {
                boxes: scene::parts(0.0)
                    .map(|(part, shape)| (pose * part, shape))
                    .into(),
                color: between(first, last, at as f64 / end),
                opacity: 1.0,
                outline: WHITE,
            });
        }
    }
    let furniture = FURNITURE.map(|block| (block, RGBColor(196, 202, 212), 0.92));
    let walls = DOOR_WALL.iter().chain(&WINDOW_WALL);
    let walls = walls.map(|&block| (block, RGBColor(150, 160, 178), 0.42));
    let standing = |(block, color, opacity): (Block, RGBColor, f64)| Solid {
        boxes: vec![body::block(block)],
        color,
        opacity,
        outline: DARK,
    };
    solids.extend(furniture.into_iter().chain(walls).map(standing));
    solid::draw(area, &projection, &solids)?;

    let workers_report = match built.workers {
        1 => "one process".to_owned(),
        workers => format!("{workers} processes"),
    };
    let title = format!(
        "A chair through three rooms: one roadmap in R³ × RP³ by {workers_report}, {} milestones, {} edges",
        built.roadmap.len(),
        built.roadmap.edge_count(),
    );
    write(area, title, (80, 66), letters(FONT_SIZES[0], DARK))?;
    let hint = format!(
        "Drawn are the {EDGES} shortest edges of each milestone, in the colour of the worker that made it."
    );
    write(area, hint, (80, 126), letters(FONT_SIZES[1], DARK))?;
    for (row, (answer, [_, color])) in built.paths.iter().zip(CHAIRS).enumerate() {
        let entry = [(answer.name, color)];
        drawing::legend(area, &entry, (80, 190 + 52 * row as i32), 0)?;
    }
    Ok(())
}

/// Floor, back and side of the rooms.
fn shell(area: &Area<'_>, projection: &Projection) -> Result<(), DrawingError> {
    let [x, y, z] = SIDES;
    let at = |x: f64, y: f64, z: f64| projection.at(Vector::new(x, y, z));
    let floor = vec![
        at(0.0, 0.0, 0.0),
        at(x, 0.0, 0.0),
        at(x, y, 0.0),
        at(0.0, y, 0.0),
    ];
    area.draw(&Polygon::new(floor, RGBColor(243, 241, 236)))?;
    let back = vec![at(0.0, y, 0.0), at(x, y, 0.0), at(x, y, z), at(0.0, y, z)];
    area.draw(&Polygon::new(back, RGBColor(248, 249, 251)))?;
    let side = vec![
        at(0.0, 0.0, 0.0),
        at(0.0, y, 0.0),
        at(0.0, y, z),
        at(0.0, 0.0, z),
    ];
    area.draw(&Polygon::new(side, RGBColor(240, 243, 247)))?;
    let line = |from, to| PathElement::new(vec![from, to], PALE.stroke_width(3));
    for step in 1..x as i32 {
        let step = f64::from(step);
        area.draw(&line(at(step, 0.0, 0.0), at(step, y, 0.0)))?;
    }
    for step in 1..y as i32 {
        let step = f64::from(step);
        area.draw(&line(at(0.0, step, 0.0), at(x, step, 0.0)))?;
    }
    let rim = [
        (at(0.0, 0.0, 0.0), at(x, 0.0, 0.0)),
        (at(x, 0.0, 0.0), at(x, y, 0.0)),
        (at(0.0, y, 0.0), at(x, y, 0.0)),
        (at(0.0, 0.0, 0.0), at(0.0, y, 0.0)),
        (at(0.0, y, 0.0), at(0.0, y, z)),
        (at(0.0, 0.0, 0.0), at(0.0, 0.0, z)),
        (at(0.0, 0.0, z), at(0.0, y, z)),
        (at(0.0, y, z), at(x, y, z)),
        (at(x, y, 0.0), at(x, y, z)),
    ];
    for (from, to) in rim {
        let line = PathElement::new(vec![from, to], RGBColor(150, 157, 170).stroke_width(4));
        area.draw(&line)?;
    }
    Ok(())
}

fn edges(
    roadmap: &Roadmap,
    scene: &Rooms,
    area: &Area<'_>,
    projection: &Projection,
) -> Result<(), DrawingError> {
    let place = |at: usize| {
        let row = roadmap.states.row(at);
        projection.at(Vector::new(row[0], row[1], row[2]))
    };
    for (at, to) in roadmap.edges.iter().enumerate() {
        let length = |other: usize| {
            let states = &roadmap.states;
            scene.space().distance(states.row(at), states.row(other))
        };
        let mut to = to.clone();
        to.sort_by(|&a, &b| length(a).total_cmp(&length(b)));
        let color = WORKERS[roadmap.workers[at] % WORKERS.len()];
        for &other in to.iter().take(EDGES) {
            let line = vec![place(at), place(other)];
            area.draw(&PathElement::new(line, color.mix(0.45).stroke_width(2)))?;
        }
        area.draw(&Circle::new(place(at), 5, color.mix(0.75).filled()))?;
    }
    Ok(())
}

fn between(first: RGBColor, last: RGBColor, share: f64) -> RGBColor {
    let mix = |a: u8, b: u8| (f64::from(a) + share * (f64::from(b) - f64::from(a))).round() as u8;
    RGBColor(
        mix(first.0, last.0),
        mix(first.1, last.1),
        mix(first.2, last.2),
    )
}
