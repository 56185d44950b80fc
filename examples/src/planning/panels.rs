//! The panels of figures that each picture has: the growth of the trees, and the share of the time spent in search.

use plotters::{
    chart::ChartBuilder,
    prelude::{IntoLogRange, PathElement},
    style::Color,
};

use super::{
    comparison::{Comparison, Run},
    drawing::{Area, DARK, DrawingError, FONT_SIZES, axes, ink, legend, letters, write},
    options::Source,
};

/// Draws both panels, one below the other, with their legend.
pub fn draw(area: &Area<'_>, comparison: &Comparison) -> Result<(), DrawingError> {
    let (_, height) = area.dim_in_pixel();
    let (head, panels) = area.split_vertically(190);
    let names: Vec<_> = comparison
        .sources
        .iter()
        .map(|&source| (source.name(), ink(source)))
        .collect();
    for (row, entries) in names.chunks(3).enumerate() {
        legend(&head, entries, (40, 40 + 56 * row as i32), 310)?;
    }
    let (growth, share) = panels.split_vertically((height - 190) / 2);
    nodes_over_time(&growth, comparison)?;
    share_over_nodes(&share, comparison)
}

/// The first run with each source.
fn first_runs(comparison: &Comparison) -> impl Iterator<Item = (Source, &Run)> {
    let of = |&source| Some((source, comparison.runs_of(source).next()?));
    comparison.sources.iter().filter_map(of)
}

fn nodes_over_time(area: &Area<'_>, comparison: &Comparison) -> Result<(), DrawingError> {
    let points = |run: &Run| -> Vec<(f64, f64)> {
        let growth = run.growth.iter();
        growth
            .map(|moment| (moment.account.total.as_secs_f64(), moment.nodes as f64))
            .collect()
    };
    let nodes = first_runs(comparison).map(|(_, run)| run.nodes);
    let most = nodes.max().unwrap_or(1) as f64;
    let ends = || first_runs(comparison).map(|(_, run)| run.account.total.as_secs_f64());
    let longest = ends().fold(f64::MIN_POSITIVE, f64::max);
    // The last two decades before the end of the shortest run show how the curves diverge.
    let shortest = ends().fold(longest, f64::min);
    let mut chart = ChartBuilder::on(area)
        .margin(30)
        .margin_top(120)
        .x_label_area_size(90)
        .y_label_area_size(130)
        .build_cartesian_2d(
            (shortest / 100.0..longest * 1.3).log_scale(),
            0.0..most * 1.05,
        )?;
    axes(
        &mut chart,
        (5, 5),
        "seconds",
        &|seconds| format!("{seconds}"),
        &|nodes| format!("{nodes:.0}"),
    )?;
    for (source, run) in first_runs(comparison) {
        let line = PathElement::new(points(run), ink(source).stroke_width(7));
        chart.draw_series([line])?;
    }
    write(
        area,
        "Nodes over time",
        (40, 50),
        letters(FONT_SIZES[0], DARK),
    )
}

fn share_over_nodes(area: &Area<'_>, comparison: &Comparison) -> Result<(), DrawingError> {
    let nodes = first_runs(comparison).map(|(_, run)| run.nodes);
    let most = nodes.max().unwrap_or(1) as f64;
    let mut chart = ChartBuilder::on(area)
        .margin(30)
        .margin_top(120)
        .x_label_area_size(90)
        .y_label_area_size(130)
        .build_cartesian_2d(0.0..most * 1.02, 0.0..100.0)?;
    axes(
        &mut chart,
        (4, 5),
        "nodes",
        &|nodes| format!("{nodes:.0}"),
        &|share| format!("{share:.0} %"),
    )?;
    for (source, run) in first_runs(comparison) {
        // The first moments have too few searches for a meaningful share.
        let settled = run.growth.iter().filter(|moment| moment.nodes > 100);
        let points = settled.map(|moment| {
            let (neighbors, total) = (moment.account.neighbors.time(), moment.account.total);
            let share = 100.0 * neighbors.as_secs_f64() / total.as_secs_f64();
            (moment.nodes as f64, share)
        });
        let line = PathElement::new(points.collect::<Vec<_>>(), ink(source).stroke_width(7));
        chart.draw_series([line])?;
    }
    write(
        area,
        "Time spent in searches and inserts",
        (40, 50),
        letters(FONT_SIZES[0], DARK),
    )
}
