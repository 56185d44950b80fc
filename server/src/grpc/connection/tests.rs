//! Prefaces, signs of life, and clients that do not read.

use std::pin::pin;

use futures_util::{StreamExt, future::join, poll};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    time::{advance, pause},
};
use tokio_rustls::client::TlsStream;

use super::*;
use crate::{admission::Admission, config::Config, grpc::tls::testing};

/// A connection to a listener of its own, and its peer, which has sent some bytes.
async fn connection(sent: &[u8]) -> (Connection, TcpStream) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let mut peer = TcpStream::connect(address).await.unwrap();
    peer.write_all(sent).await.unwrap();
    (
        accept_one(listener, None, CancellationToken::new()).await,
        peer,
    )
}

async fn accept_one(socket: TcpListener, tls: Option<Tls>, cut: CancellationToken) -> Connection {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(1, 1, admission);
    let listener = FaceListener { socket, tls };
    let mut incoming = Box::pin(incoming(listener, connections, cut));
    incoming.next().await.unwrap().unwrap()
}

/// A connection over TLS that has written more than its socket takes, and its client, which reads nothing.
async fn unread_connection(cut: CancellationToken) -> (Connection, TlsStream<TcpStream>) {
    let (tls, connector) = testing::pair();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let socket = TcpStream::connect(listener.local_addr().unwrap()).await;
    let mut connection = accept_one(listener, Some(tls), cut).await;
    let opening = async {
        let mut client = testing::connect(&connector, socket.unwrap()).await;
        client.write_all(&[0; PREFACE_BYTES]).await.unwrap();
        client
    };
    let mut preface = [0; PREFACE_BYTES];
    let (client, read) = join(opening, connection.read_exact(&mut preface)).await;
    read.unwrap();
    testing::fill(&mut connection).await;
    (connection, client)
}

#[tokio::test]
async fn a_cut_ends_a_connection_that_waits_for_its_client_to_read() {
    let cut = CancellationToken::new();
    let (mut connection, _client) = unread_connection(cut.clone()).await;
    assert!(poll!(pin!(connection.flush())).is_pending());
    assert!(poll!(pin!(connection.shutdown())).is_pending());
    cut.cancel();
    for ended in [
        poll!(pin!(connection.flush())),
        poll!(pin!(connection.shutdown())),
    ] {
        let Poll::Ready(Err(error)) = ended else {
            panic!("{ended:?}");
        };
        assert_eq!(error.kind(), io::ErrorKind::ConnectionAborted);
    }
}

#[tokio::test]
async fn a_shutdown_ends_though_its_client_reads_nothing() {
    let (mut connection, _client) = unread_connection(CancellationToken::new()).await;
    pause();
    let ended = timeout(100 * LINGER, connection.shutdown()).await;
    let error = ended.expect("an end").unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::TimedOut);
}

#[tokio::test(start_paused = true)]
async fn a_connection_without_a_preface_is_closed() {
    for sent in [&b""[..], b"PRI * HTTP/2.0"] {
        let (mut connection, _peer) = connection(sent).await;
        let mut received = Vec::new();
        let error = connection.read_to_end(&mut received).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert_eq!(received, sent);
    }
}

#[tokio::test(start_paused = true)]
async fn a_connection_with_a_preface_may_be_silent() {
    let (mut connection, _peer) = connection(&[0; PREFACE_BYTES]).await;
    let mut received = [0; PREFACE_BYTES];
    connection.read_exact(&mut received).await.unwrap();
    let silence = timeout(100 * PREFACE_TIME, connection.read(&mut received));
    assert!(silence.await.is_err());
}

#[tokio::test(start_paused = true)]
async fn a_client_that_reads_its_answer_slowly_gives_signs_of_life() {
    const STEP: Duration = Duration::from_secs(1);
    let (mut connection, mut peer) = connection(&[0; PREFACE_BYTES]).await;
    connection
        .read_exact(&mut [0; PREFACE_BYTES])
        .await
        .unwrap();
    let activity = connection.open.activity().clone();
    // Without an answer, bytes that leave are those of HTTP/2 itself.
    let opened = activity.silence();
    advance(STEP).await;
    connection.write_all(b"ping").await.unwrap();
    assert_eq!(activity.silence(), opened + STEP);
    let _answer = activity.send(1);
    connection.write_all(b"a part").await.unwrap();
    assert_eq!(activity.silence(), Duration::ZERO);
    // The client reads nothing: the rest of the answer waits.
    let part = vec![0; 1024 * 1024];
    let mut left = b"ping".len() + b"a part".len();
    // One pending write lets others have their turn; after a second, the socket has no room.
    let mut pending = 0;
    while pending < 2 {
        match poll!(pin!(connection.write(&part))) {
            Poll::Ready(written) => (left, pending) = (left + written.unwrap(), 0),
            Poll::Pending => pending += 1,
        }
    }
    advance(STEP).await;
    assert!(poll!(pin!(connection.write(&part))).is_pending());
    assert_eq!(activity.silence(), STEP);
    // It reads again.
    peer.read_exact(&mut vec![0; left]).await.unwrap();
    connection.write_all(&part[..1]).await.unwrap();
    assert_eq!(activity.silence(), Duration::ZERO);
}
