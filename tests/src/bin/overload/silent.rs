//! Connections that say nothing, and calls that are never finished.

use std::{net::SocketAddr, time::Duration};

use futures_util::future::join_all;
use tokio::{
    net::TcpStream,
    time::{Instant, sleep_until, timeout, timeout_at},
};
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;

use crate::{
    Arguments,
    generator::apart,
    probe::Bystander,
    progress,
    report::{Figures, Report, Table},
    server::{Server, knn_frames, pause},
    wire::{self, DEFAULT_WINDOW, HEALTH, KNN, LARGE_WINDOW, Outcome},
};

const SILENT: usize = 1_150;
const CONNECTIONS: usize = 17;
const CALLS: usize = 256;
/// The time in which connections are made: the system itself holds those that the server does not accept.
const CONNECT: Duration = Duration::from_secs(5);
/// The longest time that a new client waits.
const PATIENCE: Duration = Duration::from_secs(20);

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    let (name, length) = ("silent, 1,150 connections", arguments.length());
    measure(arguments, report, name, move |address| {
        silent(address, length)
    });
    let name = "silent, 17 connections with 256 headers each";
    measure(arguments, report, name, move |address| {
        headers(address, length)
    });
}

fn measure<F>(
    arguments: &Arguments,
    report: &mut Report,
    name: &str,
    hold: impl FnOnce(SocketAddr) -> F,
) where
    F: Future<Output = Figures> + Send + 'static,
{
    let server = Server::start(arguments);
    progress(name);
    let mut bystander = Bystander::start(server.address);
    bystander.part("before");
    pause(arguments.length() / 2);
    bystander.part("during");
    let memory = server.memory();
    let figures = apart(hold(server.address)).join();
    bystander.part("after");
    let memory = memory.after_the_load();
    let mut table = Table::default();
    table.column("a new client", figures.expect("the generator's thread"));
    report.table(name, &table);
    report.table(&format!("{name}: memory"), &memory);
    report.table(&format!("{name}: others"), &bystander.finish());
}

/// Holds connections that send nothing.
async fn silent(address: SocketAddr, length: Duration) -> Figures {
    let connect_by = Instant::now() + CONNECT;
    let sockets = (0..SILENT).map(|_| timeout_at(connect_by, TcpStream::connect(address)));
    let sockets = join_all(sockets).await.into_iter();
    let sockets: Vec<TcpStream> = sockets.flatten().flatten().collect();
    let mut figures = Figures::default();
    figures.add("connections held", sockets.len() as f64);
    let end = Instant::now() + length;
    newcomer(address, &mut figures).await;
    sleep_until(end).await;
    figures
}

/// Holds calls of which only the headers are sent.
async fn headers(address: SocketAddr, length: Duration) -> Figures {
    let connect_by = Instant::now() + CONNECT;
    let clients =
        (0..CONNECTIONS).map(|_| timeout_at(connect_by, wire::connect(address, DEFAULT_WINDOW)));
    let clients: Vec<_> = join_all(clients)
        .await
        .into_iter()
        .flatten()
        .flatten()
        .collect();
    let (mut responses, mut bodies) = (Vec::new(), Vec::new());
    for client in &clients {
        for _ in 0..CALLS {
            let begun = client
                .clone()
                .send_request(wire::headers(address, KNN), false);
            if let Ok((response, body)) = begun {
                responses.push(wire::outcome(response));
                bodies.push(body);
            }
        }
    }
    let mut figures = Figures::default();
    figures.add("calls with headers alone", bodies.len() as f64);
    let end = Instant::now() + length;
    sleep_until(Instant::now() + Duration::from_secs(1)).await;
    newcomer(address, &mut figures).await;
    // Those that have no outcome by now are held by the server.
    let outcomes = responses
        .into_iter()
        .map(|response| timeout_at(end, response));
    let ended = join_all(outcomes).await.into_iter().flatten().count();
    figures.add("of them refused, reset or lost", ended as f64);
    figures
}

/// The time until a new client's calls are answered, or its patience is at its end.
async fn newcomer(address: SocketAddr, figures: &mut Figures) {
    let check = wire::frame(&HealthCheckRequest::default());
    let search = knn_frames(1, 1, 10)[0].clone();
    for (name, path, message) in [("health", HEALTH, check), ("Knn", KNN, search)] {
        let began = Instant::now();
        let call = async {
            let client = wire::connect(address, LARGE_WINDOW).await?;
            let headers = wire::headers(address, path);
            Ok(wire::call(&client, headers, message).await)
        };
        let outcome: Result<Result<Outcome, Outcome>, _> = timeout(PATIENCE, call).await;
        figures.add(
            &format!("{name} after, ms"),
            began.elapsed().as_secs_f64() * 1e3,
        );
        let answered = matches!(outcome, Ok(Ok(Outcome::Status(Code::Ok))));
        figures.add(&format!("{name} answered"), f64::from(u8::from(answered)));
    }
}
