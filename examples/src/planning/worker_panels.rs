//! The panels of figures about several workers: their progress, and the account of their time.

use plotters::{
    chart::ChartBuilder,
    prelude::{PathElement, RGBColor, Rectangle},
    style::Color,
};

use super::{
    drawing::{Area, DARK, DrawingError, FONT_SIZES, WORKERS, axes, legend, letters, write},
    processes::{Account, WorkersReport},
};

/// The parts of the time.
const PARTS: [(&str, RGBColor); 4] = [
    ("collision checks", RGBColor(120, 130, 148)),
    ("waiting for inserts and updates", RGBColor(190, 62, 72)),
    ("searches", RGBColor(110, 84, 178)),
    ("rest", RGBColor(214, 218, 226)),
];

/// The number of things that each worker and all workers had made over time. `what` names them and begins the title.
pub fn growth<A: Account>(
    area: &Area<'_>,
    workers_report: &WorkersReport<A>,
    what: &str,
) -> Result<(), DrawingError> {
    let mut own = vec![vec![(0.0, 0.0)]; workers_report.accounts.len()];
    let mut all = vec![(0.0, 0.0)];
    let mut now = vec![0; workers_report.accounts.len()];
    for progress in &workers_report.growth {
        let at = progress.at.as_secs_f64();
        now[progress.worker] = progress.made;
        own[progress.worker].push((at, progress.made as f64));
        all.push((at, now.iter().sum::<u64>() as f64));
    }
    let most = now.iter().sum::<u64>().max(1) as f64;
    let wall = workers_report.wall.as_secs_f64().max(f64::MIN_POSITIVE);
    let mut chart = ChartBuilder::on(area)
        .margin_left(40)
        .margin_right(40)
        .margin_bottom(20)
        .margin_top(120)
        .x_label_area_size(90)
        .y_label_area_size(130)
        .build_cartesian_2d(0.0..wall, 0.0..most * 1.05)?;
    let count = |made: &f64| format!("{made:.0}");
    axes(&mut chart, (6, 5), "seconds", &f64::to_string, &count)?;
    chart.draw_series([PathElement::new(all, DARK.stroke_width(8))])?;
    for (worker, line) in own.into_iter().enumerate() {
        let color = WORKERS[worker % WORKERS.len()];
        chart.draw_series([PathElement::new(line, color.stroke_width(6))])?;
    }
    let title = format!("{what} over time: all, and by each worker");
    write(area, title, (80, 56), letters(FONT_SIZES[0], DARK))
}

/// One bar for each worker: the shares of its time, and the share of searches as a number.
pub fn shares<A: Account>(
    area: &Area<'_>,
    workers_report: &WorkersReport<A>,
) -> Result<(), DrawingError> {
    let (width, height) = area.dim_in_pixel();
    let title = "Where the workers' time went; in figures: searches";
    write(area, title, (40, 56), letters(FONT_SIZES[0], DARK))?;
    for (row, parts) in PARTS.chunks(2).enumerate() {
        legend(area, parts, (40, 130 + 52 * row as i32), 420)?;
    }
    let (left, right) = (240.0, f64::from(width) - 150.0);
    let each = (f64::from(height) - 330.0) / workers_report.accounts.len() as f64;
    for (worker, account) in workers_report.accounts.iter().enumerate() {
        let times = account.times();
        let (top, color) = (
            250.0 + each * worker as f64,
            WORKERS[worker % WORKERS.len()],
        );
        let middle = (top + 0.4 * each) as i32;
        let name = format!("worker {worker}");
        write(area, name, (40, middle), letters(FONT_SIZES[1], color))?;
        let known = [times.checking, times.waiting, times.searching];
        let known = known.map(|part| times.percent(part) / 100.0);
        let rest = (1.0 - known.iter().sum::<f64>()).max(0.0);
        let mut from = left;
        for (share, (_, color)) in known.into_iter().chain([rest]).zip(PARTS) {
            let to = from + share * (right - left);
            let corners = [
                (from.round() as i32, top.round() as i32),
                (to.round() as i32, (top + 0.8 * each).round() as i32),
            ];
            area.draw(&Rectangle::new(corners, color.filled()))?;
            from = to;
        }
        let share = format!("{:.1} %", times.percent(times.searching));
        write(
            area,
            share,
            (right as i32 + 20, middle),
            letters(FONT_SIZES[1], DARK),
        )?;
    }
    Ok(())
}
