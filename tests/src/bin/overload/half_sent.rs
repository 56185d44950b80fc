//! One connection with inserts that never end.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::Duration,
};

use bytes::Bytes;
use futures_util::future::poll_fn;
use h2::SendStream;
use tokio::{
    task::JoinSet,
    time::{Instant, sleep_until, timeout_at},
};

use crate::{
    Arguments,
    generator::apart,
    probe::Bystander,
    progress,
    report::{Figures, Report, Table},
    server::{Server, insert_frame, pause},
    wire::{self, DEFAULT_WINDOW, INSERT, Outcome},
};

const CALLS: usize = 250;
/// A message of about 15 MB, below the server's limit of 16 MiB.
const ROWS: usize = 250_000;
/// The bytes that are sent of each message.
const SENT: usize = 1_500_000_000 / CALLS;
const CHUNK: usize = 64 * 1024;
/// The client stops once the server has taken nothing for this long.
const SILENCE: Duration = Duration::from_secs(2);
const LONGEST: Duration = Duration::from_secs(30);

/// The bytes that the inserts sent, and the inserts that ended.
#[derive(Default)]
struct Inserts {
    sent_bytes: u64,
    ended: u64,
}

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    let server = Server::start(arguments);
    progress("half-sent");
    let memory = server.memory();
    let mut bystander = Bystander::start(server.address);
    bystander.part("before");
    pause(arguments.length() / 2);
    bystander.part("during");
    let inserts = apart(send(server.address)).join();
    let inserts = inserts.expect("the generator's thread");
    bystander.part("after");
    let memory = memory.after_the_load();
    let mut figures = Figures::default();
    figures.add("inserts begun", CALLS as f64);
    figures.add("taken, MiB", inserts.sent_bytes as f64 / 1024.0 / 1024.0);
    figures.add("refused, reset or lost", inserts.ended as f64);
    let mut table = Table::default();
    table.column("inserts", figures);
    report.table("half-sent, inserts", &table);
    report.table("half-sent, memory", &memory);
    report.table("half-sent, others", &bystander.finish());
}

/// Sends parts of inserts over one connection until all are sent or the server takes no more.
async fn send(address: SocketAddr) -> Inserts {
    let end = Instant::now() + LONGEST;
    let mut inserts = Inserts::default();
    let Ok(client) = wire::connect(address, DEFAULT_WINDOW).await else {
        return inserts;
    };
    let message = insert_frame(ROWS);
    let sent = Arc::new(AtomicU64::new(0));
    let mut calls = JoinSet::new();
    for _ in 0..CALLS {
        let begun = client
            .clone()
            .send_request(wire::headers(address, INSERT), false);
        let Ok((response, mut body)) = begun else {
            inserts.ended += 1;
            continue;
        };
        let (message, sent) = (message.slice(..SENT), Arc::clone(&sent));
        calls.spawn(async move {
            let mut outcome = Box::pin(wire::outcome(response));
            tokio::select! {
                ended = &mut outcome => return ended,
                fed = feed(&mut body, message, &sent) => if let Err(error) = fed {
                    return error.into();
                },
            }
            // The insert stays unfinished until the server or this client ends it.
            outcome.await
        });
    }
    let mut last = 0;
    while Instant::now() < end {
        let silence_end = end.min(Instant::now() + SILENCE);
        sleep_until(silence_end).await;
        let now = sent.load(Relaxed);
        if now == last {
            break;
        }
        last = now;
    }
    while let Ok(Some(ended)) = timeout_at(Instant::now(), calls.join_next()).await {
        inserts.ended += u64::from(ended.is_ok_and(|_: Outcome| true));
    }
    inserts.sent_bytes = sent.load(Relaxed);
    inserts
}

/// Sends bytes as the server has room for them.
async fn feed(
    body: &mut SendStream<Bytes>,
    mut bytes: Bytes,
    sent: &AtomicU64,
) -> Result<(), h2::Error> {
    while !bytes.is_empty() {
        body.reserve_capacity(CHUNK.min(bytes.len()));
        let Some(room) = poll_fn(|context| body.poll_capacity(context)).await else {
            break;
        };
        let chunk = bytes.split_to(room?.min(bytes.len()));
        sent.fetch_add(chunk.len() as u64, Relaxed);
        body.send_data(chunk, false)?;
    }
    Ok(())
}
