//! Workers that all ask at once every second, within what the server can answer on average.

use std::time::Duration;

use crate::{
    Arguments,
    generator::Load,
    goodput,
    probe::Health,
    progress,
    report::{Figures, Report, Table},
    server::{Server, knn_frames},
};

const WORKERS: usize = 64;
/// The part of a second that the answers to a burst take.
const SHARE: f64 = 0.6;

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    let server = Server::start(arguments);
    progress("burst: peak");
    let rows_per_second = goodput::peak(&server, arguments.length()) * goodput::ROWS as f64;
    let rows = (SHARE * rows_per_second / WORKERS as f64).max(1.0) as usize;
    progress(&format!("burst: {WORKERS} workers, {rows} rows each"));
    let load = Load {
        address: server.address,
        connections: WORKERS,
        requests: knn_frames(WORKERS, rows, 10),
        deadline: None,
    };
    let health = Health::start(server.address);
    let tally = goodput::on_schedule(load, arguments.length(), |n| {
        Duration::from_secs(n / WORKERS as u64)
    });
    let mut figures = Figures::default();
    figures.add("rows of a call", rows as f64);
    figures.add("bursts", f64::from(arguments.seconds));
    figures.add("refused", tally.refusals() as f64);
    figures.extend(tally.figures(None));
    figures.extend(health.finish(server.settle()));
    let mut table = Table::default();
    table.column("burst", figures);
    report.table("burst, 64 workers once a second", &table);
}
