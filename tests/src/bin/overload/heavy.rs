//! One connection with 250 large searches under way, whose answers are read.

use crate::{
    Arguments,
    generator::{Load, apart},
    probe::Bystander,
    progress,
    report::{Report, Table},
    server::{Server, knn_frames, pause},
};

const CALLS: u64 = 250;
const ROWS: usize = 4;
const K: u32 = 10_000;

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    let server = Server::start(arguments);
    progress("heavy");
    let load = Load {
        address: server.address,
        connections: 1,
        requests: knn_frames(64, ROWS, K),
        deadline: None,
    };
    let memory = server.memory();
    let mut bystander = Bystander::start(server.address);
    bystander.part("before");
    pause(arguments.length());
    bystander.part("during");
    let heavy = apart(load.closed(CALLS, arguments.length())).join();
    let heavy = heavy.expect("the generator's thread");
    bystander.part("after");
    let memory = memory.after_the_load();
    let mut table = Table::default();
    table.column("heavy calls", heavy.figures(None));
    report.table("heavy, 250 Knn on one connection", &table);
    report.table("heavy, memory", &memory);
    report.table("heavy, others", &bystander.finish());
}
