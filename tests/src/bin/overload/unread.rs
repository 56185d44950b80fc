//! Connections whose client asks for large answers and reads none.

use std::{net::SocketAddr, time::Duration};

use h2::{SendStream, client::ResponseFuture};
use tokio::time::{Instant, sleep_until};
use wayfold_proto::v1::StreamKnnRequest;

use crate::{
    Arguments,
    generator::apart,
    probe::Bystander,
    progress,
    report::Report,
    server::{Server, knn, knn_frames, pause, until_idle},
    wire::{self, Client, DEFAULT_WINDOW, KNN, STREAM_KNN},
};

const K: u32 = 10_000;
const STREAMS: usize = 16;
const REQUESTS: usize = 128;
/// Answers of 4.0 MB, below the limit.
const STREAM_ROWS: usize = 25;
const CALLS: usize = 250;
/// Answers of 2.9 MB.
const CALL_ROWS: usize = 18;
/// The time that the server gets to prepare the answers.
const LONGEST: Duration = Duration::from_secs(40);

type UnreadCall = (ResponseFuture, SendStream<bytes::Bytes>);

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    measure(arguments, report, "unread, 16 StreamKnn of 128", 1, streams);
    measure(arguments, report, "unread, 250 Knn", 1, calls);
    let name = "unread, 250 Knn on each of 10 connections";
    measure(arguments, report, name, 10, calls);
}

fn measure(
    arguments: &Arguments,
    report: &mut Report,
    name: &str,
    connections: usize,
    begin: fn(&Client, SocketAddr) -> Vec<UnreadCall>,
) {
    let server = Server::start(arguments);
    progress(name);
    let memory = server.memory();
    let mut bystander = Bystander::start(server.address);
    bystander.part("before");
    pause(arguments.length() / 2);
    bystander.part("during");
    let (address, process) = (server.address, server.id());
    let held = apart(async move {
        let mut unread = Vec::new();
        for _ in 0..connections {
            let client = wire::connect(address, DEFAULT_WINDOW).await;
            unread.push(client.map(|client| (begin(&client, address), client)));
        }
        sleep_until(Instant::now() + Duration::from_secs(1)).await;
        until_idle(process, LONGEST).await;
        drop(unread);
    });
    held.join().expect("the generator's thread");
    bystander.part("after");
    report.table(&format!("{name}: memory"), &memory.after_the_load());
    report.table(&format!("{name}: others"), &bystander.finish());
}

fn streams(client: &Client, address: SocketAddr) -> Vec<UnreadCall> {
    let requests = knn(REQUESTS, STREAM_ROWS, K).into_iter();
    let requests = requests.map(|knn| wire::frame(&StreamKnnRequest { knn: Some(knn) }));
    let requests: Vec<_> = requests.collect();
    let mut unread = Vec::new();
    for _ in 0..STREAMS {
        let headers = wire::headers(address, STREAM_KNN);
        let Ok((response, mut body)) = client.clone().send_request(headers, false) else {
            break;
        };
        for request in &requests {
            // A stream that has ended takes no more.
            let _ = body.send_data(request.clone(), false);
        }
        unread.push((response, body));
    }
    unread
}

fn calls(client: &Client, address: SocketAddr) -> Vec<UnreadCall> {
    let mut unread = Vec::new();
    for request in knn_frames(CALLS, CALL_ROWS, K).iter() {
        let headers = wire::headers(address, KNN);
        let Ok((response, mut body)) = client.clone().send_request(headers, false) else {
            break;
        };
        let _ = body.send_data(request.clone(), true);
        unread.push((response, body));
    }
    unread
}
