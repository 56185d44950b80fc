//! Slots that change hands, and connections that are cut.

use std::pin::pin;

use futures_util::{future::join, poll};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::{TcpListener, TcpStream},
    spawn,
    time::{advance, pause},
};
use tokio_rustls::client::TlsStream;

use super::*;
use crate::grpc::{Tls, tls_testing};

/// A connection that takes a slot, and its client.
async fn connect(
    listener: &TcpListener,
    slots: &Arc<ConnectionSlots>,
) -> (TcpStream, BoundedConnection) {
    let address = listener.local_addr().unwrap();
    let client = TcpStream::connect(address).await.unwrap();
    let slot = slots.take().await;
    let (socket, _) = listener.accept().await.unwrap();
    (
        client,
        BoundedConnection::new(Tls::accept(None, socket, Arc::default()), slot),
    )
}

async fn listen() -> TcpListener {
    TcpListener::bind("127.0.0.1:0").await.unwrap()
}

#[tokio::test(start_paused = true)]
async fn a_silent_connection_gives_its_slot_up_after_its_time() {
    let slots = ConnectionSlots::new(1);
    let (mut client, mut bounded) = connect(&listen().await, &slots).await;
    client.write_all(b"G").await.unwrap();
    assert_eq!(bounded.read_u8().await.unwrap(), b'G');
    let began = Instant::now();
    let ended = bounded.read_u8().await.unwrap_err();
    assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
    assert!(began.elapsed() >= MAX_STALL);
    assert_eq!(slots.free.available_permits(), 0);
    drop(bounded);
    assert_eq!(slots.free.available_permits(), 1);
}

#[tokio::test]
async fn a_connection_ends_that_sends_much_for_no_call() {
    let (mut client, mut bounded) = connect(&listen().await, &ConnectionSlots::new(1)).await;
    let mut head = vec![0; MAX_HEAD_BYTES];
    for _ in 0..2 {
        client.write_all(&head).await.unwrap();
        bounded.read_exact(&mut head).await.unwrap();
        bounded.write_all(b"an answer").await.unwrap();
    }
    let call = bounded.slot.calls.token();
    client.write_all(&head).await.unwrap();
    bounded.read_exact(&mut head).await.unwrap();
    drop(call);
    client.write_all(&head).await.unwrap();
    bounded.read_exact(&mut head).await.unwrap();
    client.write_all(b"G").await.unwrap();
    let ended = bounded.read_u8().await.unwrap_err();
    assert_eq!(ended.kind(), io::ErrorKind::ConnectionAborted);
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_takes_answers_goes_on() {
    let (_client, mut bounded) = connect(&listen().await, &ConnectionSlots::new(1)).await;
    for _ in 0..4 {
        advance(MAX_STALL / 2).await;
        bounded.write_all(b"more").await.unwrap();
    }
    advance(MAX_STALL).await;
    let ended = bounded.write_all(b"more").await.unwrap_err();
    assert_eq!(ended.kind(), io::ErrorKind::TimedOut);
}

#[tokio::test(start_paused = true)]
async fn the_longest_silence_makes_room() {
    let (listener, slots) = (listen().await, ConnectionSlots::new(2));
    let (_live, mut live) = connect(&listener, &slots).await;
    let (_silent, mut silent) = connect(&listener, &slots).await;
    advance(MIN_SILENCE).await;
    live.write_all(b"an answer").await.unwrap();
    // A connection that is cut ends at its next poll, and frees its slot.
    let ended = tokio::spawn(async move { silent.read_u8().await.unwrap_err().kind() });
    let began = Instant::now();
    let _third = connect(&listener, &slots).await;
    assert!(began.elapsed() < MAX_STALL);
    assert_eq!(ended.await.unwrap(), io::ErrorKind::ConnectionAborted);
    live.write_all(b"another").await.unwrap();
}

/// The end of a connection that writes again and again before it counts as silent.
async fn keep_active(mut bounded: BoundedConnection) -> io::ErrorKind {
    loop {
        if let Err(error) = bounded.write_all(b"alive").await {
            return error.kind();
        }
        // The clock is paused.
        sleep_until(Instant::now() + MIN_SILENCE / 2).await;
    }
}

#[tokio::test(start_paused = true)]
async fn the_first_connection_without_a_call_makes_room_if_none_is_silent() {
    let (listener, slots) = (listen().await, ConnectionSlots::new(3));
    let mut clients = Vec::new();
    let mut open = Vec::new();
    for _ in 0..3 {
        let (client, bounded) = connect(&listener, &slots).await;
        clients.push(client);
        open.push(bounded);
    }
    let _call = open[0].slot.calls.token();
    let open: Vec<_> = open.into_iter().map(|it| spawn(keep_active(it))).collect();
    let taken = timeout(10 * MIN_SILENCE, slots.take()).await;
    assert!(taken.is_ok(), "no slot");
    let is_ended: Vec<bool> = open.iter().map(|it| it.is_finished()).collect();
    assert_eq!(is_ended, [false, true, false]);
}

#[tokio::test(start_paused = true)]
async fn a_cut_connection_that_does_not_end_is_not_the_only_one_cut() {
    let slots = ConnectionSlots::new(2);
    let held = [slots.take().await, slots.take().await];
    assert!(timeout(10 * MIN_SILENCE, slots.take()).await.is_err());
    assert!(held.iter().all(|slot| slot.cut.is_cancelled()));
}

/// A connection over TLS that has written more than its socket takes, and its client, which reads nothing.
async fn unread_connection() -> (BoundedConnection, TlsStream<TcpStream>) {
    let (tls, connector) = tls_testing::pair();
    let listener = listen().await;
    let client = TcpStream::connect(listener.local_addr().unwrap()).await;
    let (socket, _) = listener.accept().await.unwrap();
    let socket = Tls::accept(Some(&tls), socket, Arc::default());
    let mut bounded = BoundedConnection::new(socket, ConnectionSlots::new(1).take().await);
    let opening = async {
        let mut client = tls_testing::connect(&connector, client.unwrap()).await;
        client.write_all(b"G").await.unwrap();
        client
    };
    let (client, read) = join(opening, bounded.read_u8()).await;
    assert_eq!(read.unwrap(), b'G');
    tls_testing::fill(&mut bounded).await;
    (bounded, client)
}

async fn assert_ends(bounded: &mut BoundedConnection, kind: io::ErrorKind) {
    for ended in [
        poll!(pin!(bounded.flush())),
        poll!(pin!(bounded.shutdown())),
    ] {
        let Poll::Ready(Err(error)) = ended else {
            panic!("{ended:?}");
        };
        assert_eq!(error.kind(), kind);
    }
}

#[tokio::test]
async fn a_cut_ends_a_connection_that_waits_for_its_client_to_read() {
    let (mut bounded, _client) = unread_connection().await;
    assert!(poll!(pin!(bounded.flush())).is_pending());
    bounded.slot.cut.cancel();
    assert_ends(&mut bounded, io::ErrorKind::ConnectionAborted).await;
}

#[tokio::test]
async fn a_connection_ends_after_its_time_while_its_client_reads_nothing() {
    let (mut bounded, _client) = unread_connection().await;
    pause();
    advance(MAX_STALL).await;
    assert_ends(&mut bounded, io::ErrorKind::TimedOut).await;
}

#[tokio::test(start_paused = true)]
async fn the_longest_silence_makes_room_if_all_have_calls() {
    let (listener, slots) = (listen().await, ConnectionSlots::new(2));
    let (_live, mut live) = connect(&listener, &slots).await;
    let (_silent, mut silent) = connect(&listener, &slots).await;
    let _calls = [live.slot.calls.token(), silent.slot.calls.token()];
    advance(MIN_SILENCE).await;
    live.write_all(b"an answer").await.unwrap();
    let ended = tokio::spawn(async move { silent.read_u8().await.unwrap_err().kind() });
    let began = Instant::now();
    let _third = connect(&listener, &slots).await;
    assert!(began.elapsed() < MAX_STALL);
    assert_eq!(ended.await.unwrap(), io::ErrorKind::ConnectionAborted);
}
