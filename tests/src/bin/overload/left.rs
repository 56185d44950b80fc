//! A client of Zenoh that sends large queries and leaves before they are answered.

use std::{process::ExitCode, time::Duration};

use futures_util::future::join_all;
use prost::Message;
use wayfold_tests::{Process, measuring};
use zenoh::bytes::Encoding;

use crate::{
    Arguments,
    probe::Bystander,
    progress,
    report::{Figures, Report, Table},
    server::{INDEX, Server, knn, pause},
};

/// The role of the process that asks and leaves. Its argument is the server's locator.
pub(crate) const LEAVER: &str = "leaver";

const QUERIES: usize = 600;
const ROWS: usize = 5_000;
/// The longest time for which the server may work on after the client has left.
const LONGEST: Duration = Duration::from_secs(90);

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    let server = Server::start(arguments);
    progress("left");
    let memory = server.memory();
    let mut bystander = Bystander::start(server.address);
    bystander.part("before");
    pause(arguments.length() / 2);
    let before = server.until_idle(Duration::from_secs(1));
    bystander.part("during");
    let mut command = measuring::command(LEAVER);
    let leaver = Process::spawn(command.arg(&server.zenoh)).finish();
    let after = server.until_idle(LONGEST);
    bystander.part("after");
    let mut figures = Figures::default();
    let sent = leaver.stdout.first().and_then(|line| line.parse().ok());
    figures.add("queries sent", sent.unwrap_or(f64::NAN));
    figures.add("processor time after the client left, s", after);
    figures.add("processor time of one second before, s", before);
    let mut table = Table::default();
    table.column("left", figures);
    report.table("left, 600 queries of 5,000 rows over Zenoh", &table);
    report.table("left, memory", &memory.after_the_load());
    report.table("left, others", &bystander.finish());
}

/// Sends the queries and ends.
pub(crate) fn leave() -> ExitCode {
    let locator = std::env::args().nth(1).expect("a locator");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let sent = runtime.block_on(async {
        let payload = knn(1, ROWS, 10)[0].encode_to_vec();
        let session = measuring::connect(&locator).await;
        let key = format!("wayfold/v1/{INDEX}/knn");
        let queries = (0..QUERIES).map(|_| {
            let query = session.get(&key).payload(payload.clone());
            query.encoding(Encoding::APPLICATION_PROTOBUF).into_future()
        });
        let replies = join_all(queries).await;
        let sent = replies.iter().flatten().count();
        // The session closes with the queries unanswered.
        let _ = session.close().await;
        sent
    });
    println!("{sent}");
    ExitCode::SUCCESS
}
