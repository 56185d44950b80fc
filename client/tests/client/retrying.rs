//! The calls that the client retries, and those that it does not.

use std::time::Duration;

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpListener,
};
use tonic::Status;
use tonic_types::{ErrorDetails, StatusExt};
use wayfold::{Client, Code, Error, Include, READ_ROWS, RetryPolicy};

use crate::fake::Fake;

/// A policy of `attempts` tries with short pauses.
pub(crate) fn quick(attempts: u32) -> RetryPolicy {
    RetryPolicy {
        attempts,
        first: Duration::from_micros(10),
        longest: Duration::from_micros(10),
    }
}

async fn connect(fake: &Fake, policy: RetryPolicy) -> Client {
    Client::builder()
        .retry(policy)
        .connect(&fake.uri)
        .await
        .unwrap()
}

#[tokio::test]
async fn a_server_that_is_starting_is_asked_again() {
    let fake = Fake::start().await;
    let index = connect(&fake, quick(5)).await.index("line").await.unwrap();
    fake.unavailable(2);
    let neighbors = index.knn([[0.0]]).await.unwrap();
    assert_eq!(neighbors.row(0).ids().collect::<Vec<_>>(), [0]);
    assert_eq!(fake.calls(), 3);
}

#[tokio::test]
async fn tries_are_counted() {
    let fake = Fake::start().await;
    let index = connect(&fake, quick(4)).await.index("line").await.unwrap();
    fake.unavailable(usize::MAX);
    let error = index.knn([[0.0]]).await.unwrap_err();
    assert!(
        matches!(&error, Error::Refused(refusal) if refusal.code == Code::Unavailable),
        "{error}"
    );
    assert_eq!(fake.calls(), 4);
}

#[tokio::test]
async fn no_try_begins_after_the_deadline() {
    let fake = Fake::start().await;
    let never_in_time = RetryPolicy {
        attempts: 5,
        first: Duration::from_secs(3600),
        longest: Duration::from_secs(3600),
    };
    let index = connect(&fake, never_in_time)
        .await
        .index("line")
        .await
        .unwrap();
    fake.unavailable(usize::MAX);
    assert_eq!(
        index.knn([[0.0]]).await.unwrap_err().code(),
        Code::Unavailable
    );
    assert_eq!(fake.calls(), 1);
}

#[tokio::test]
async fn a_busy_server_is_asked_again() {
    let fake = Fake::start().await;
    let index = connect(&fake, quick(5)).await.index("line").await.unwrap();
    let busy = || {
        let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(1)));
        Status::with_error_details(Code::ResourceExhausted, "busy", details)
    };
    fake.fail(move |number, _| (number < 2).then(busy));
    index.insert([[0.0]]).await.unwrap();
    assert_eq!(fake.calls(), 3);
}

#[tokio::test]
async fn every_try_of_a_mutation_has_the_same_operation_id_and_every_mutation_its_own() {
    let fake = Fake::start().await;
    let index = connect(&fake, quick(5)).await.index("line").await.unwrap();
    fake.unavailable(1);
    index.insert([[0.0]]).await.unwrap();
    index.insert([[0.0]]).await.unwrap();
    let ids: Vec<String> = fake
        .insert_requests()
        .into_iter()
        .map(|request| request.operation_id)
        .collect();
    assert_eq!(ids.len(), 3);
    assert_eq!(ids[0], ids[1]);
    assert_ne!(ids[1], ids[2]);
    assert!(ids.iter().all(|id| !id.is_empty() && id.len() <= 64));

    index.insert([[0.0]]).operation_id("mine").await.unwrap();
    assert_eq!(fake.insert_requests()[3].operation_id, "mine");
}

#[tokio::test]
async fn each_call_tells_the_server_its_deadline() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    index
        .with_timeout(Duration::from_secs(2))
        .knn([[0.0]])
        .await
        .unwrap();
    for timeout in fake.timeouts() {
        let timeout = timeout.expect("a grpc-timeout");
        assert!(
            timeout.ends_with(|unit: char| "numSMH".contains(unit)),
            "{timeout}"
        );
    }
    // A stream has none, as that would bound the whole of it.
    let failed = index.scan().await.unwrap_err();
    assert!(
        matches!(failed, Error::Protocol { call: "scan", .. }),
        "{failed}"
    );
    assert_eq!(fake.timeouts().last().unwrap(), &None);
}

/// The value of `grpc-timeout` of the last calls, the latest first.
pub(crate) fn last_timeouts(fake: &Fake) -> impl Iterator<Item = Duration> {
    fake.timeouts().into_iter().rev().map(|timeout| {
        let timeout = timeout.expect("a grpc-timeout");
        let (number, unit) = timeout.split_at(timeout.len() - 1);
        let unit = match unit {
            "n" => Duration::from_nanos(1),
            "u" => Duration::from_micros(1),
            "m" => Duration::from_millis(1),
            other => panic!("{other}"),
        };
        unit * number.parse().unwrap()
    })
}

#[tokio::test]
async fn a_description_has_the_timeout_of_its_handle() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let timeout = Duration::from_secs(2);
    index.with_timeout(timeout).info().await.unwrap();
    assert!(last_timeouts(&fake).next().unwrap() <= timeout);
}

#[tokio::test]
async fn a_call_and_the_call_for_the_limits_before_it_have_one_timeout() {
    let fake = Fake::start().await;
    fake.describe_for(Duration::from_secs(20));
    let ids: Vec<u64> = (0..=READ_ROWS as u64).collect();
    fake.stores(&ids);
    for request in ["knn", "get", "query", "remove"] {
        // Its timeout is 30 s, and it does not know the limits.
        let index = fake.client().await.index("line").await.unwrap();
        match request {
            "knn" => drop(index.knn(vec![[0.0]; ids.len()]).await.unwrap()),
            "get" => {
                let none = Include::none().payloads();
                index.get(ids.clone()).include(none).await.unwrap();
            }
            // The fake's answer is against the protocol.
            "query" => drop(index.query([[0.0], [1.0]], 1.0).await.unwrap_err()),
            _ => drop(index.remove([1, 2]).await.unwrap()),
        }
        let mut timeouts = last_timeouts(&fake);
        if ["knn", "get"].contains(&request) {
            // The second part has a timeout of its own.
            assert!(
                timeouts.next().unwrap() > Duration::from_secs(20),
                "{request}"
            );
        }
        assert!(
            timeouts.next().unwrap() <= Duration::from_secs(10),
            "{request}"
        );
    }
    assert_eq!(fake.times_described(), 4);
}

#[tokio::test]
async fn silence_is_a_timeout() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    fake.fall_silent();
    let error = index
        .with_timeout(Duration::from_millis(20))
        .knn([[0.0]])
        .await
        .unwrap_err();
    assert_eq!(error.code(), Code::DeadlineExceeded);
    assert_eq!(error.to_string(), "knn: no answer within 20ms");
    let error = index
        .with_timeout(Duration::from_millis(20))
        .scan()
        .await
        .unwrap_err();
    assert!(
        matches!(error, Error::Timeout { call: "scan", .. }),
        "{error}"
    );
}

#[tokio::test]
async fn a_server_that_is_not_reached_in_time_is_named() {
    // The last try has no time left, or the first has none.
    for timeout in [Duration::from_millis(50), Duration::ZERO] {
        let client = Client::builder()
            .timeout(timeout)
            .retry(RetryPolicy::until_deadline());
        let error = client.connect("127.0.0.1:0").await.err().unwrap();
        assert_eq!(error.code(), Code::Unavailable, "{error}");
        let message = error.to_string();
        assert!(
            message.starts_with("connect: no connection to http://127.0.0.1:0: "),
            "{message}"
        );
    }
}

#[tokio::test]
async fn a_connection_that_breaks_is_made_anew() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}", listener.local_addr().unwrap());
    let broken = tokio::spawn(async move {
        // The server accepts the first connection, and drops it once a request arrives.
        let (socket, _) = listener.accept().await.unwrap();
        socket.readable().await.unwrap();
        drop(socket);
        Fake::serve(listener)
    });
    let client = Client::builder()
        .retry(quick(100))
        .connect(&uri)
        .await
        .unwrap();
    let index = client.index("line").await.unwrap();
    assert_eq!(index.name(), "line");
    let fake = broken.await.unwrap();
    assert_eq!(fake.calls(), 1);
}

/// A server that stops takes no more calls on a connection. The client may still send one before it hears of the stop,
/// or while the connection closes. The server does not take that call. The client makes it again on the next
/// connection.
#[tokio::test]
async fn a_call_on_a_connection_that_is_going_away_is_made_again() {
    // Frames of HTTP/2 (RFC 9113): length, type, flags, stream. SETTINGS, then GOAWAY: no stream was taken, no error.
    const SETTINGS: &[u8] = b"\0\0\0\x04\0\0\0\0\0";
    const GOAWAY: &[u8] = b"\0\0\x08\x07\0\0\0\0\0\0\0\0\0\0\0\0\0";
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}", listener.local_addr().unwrap());
    let going = tokio::spawn(async move {
        for waits_for_a_call in [true, false] {
            let (mut socket, _) = listener.accept().await.unwrap();
            socket.write_all(SETTINGS).await.unwrap();
            if waits_for_a_call {
                let mut received = Vec::new();
                // HEADERS of the first stream.
                while !received
                    .windows(9)
                    .any(|bytes| bytes[3] == 1 && bytes[5..] == [0, 0, 0, 1])
                {
                    assert_ne!(socket.read_buf(&mut received).await.unwrap(), 0);
                }
            }
            socket.write_all(GOAWAY).await.unwrap();
        }
        Fake::serve(listener)
    });
    let client = Client::builder()
        .retry(quick(100))
        .connect(&uri)
        .await
        .unwrap();
    assert_eq!(client.index("line").await.unwrap().name(), "line");
    let fake = going.await.unwrap();
    assert_eq!(fake.calls(), 1);
}

#[tokio::test]
async fn a_refusal_that_says_cancelled_is_not_asked_again() {
    let fake = Fake::start().await;
    let index = connect(&fake, quick(5)).await.index("line").await.unwrap();
    fake.fail(|_, _| Some(Status::cancelled("operation was canceled")));
    let error = index.knn([[0.0]]).await.unwrap_err();
    assert!(matches!(error, Error::Refused(_)), "{error}");
    assert_eq!(fake.calls(), 1);
}

#[tokio::test]
async fn where_no_server_is_the_address_is_named() {
    let error = Client::builder()
        .retry(quick(3))
        .connect("127.0.0.1:0")
        .await
        .unwrap_err();
    assert_eq!(error.code(), Code::Unavailable);
    let message = error.to_string();
    assert!(
        message.starts_with("connect: no connection to http://127.0.0.1:0: Connection refused"),
        "{message}"
    );
}

#[tokio::test]
async fn an_answer_against_the_protocol_is_an_error() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    let error = index.query([[0.0]], 1.0).await.unwrap_err();
    assert!(
        matches!(error, Error::Protocol { call: "query", .. }),
        "{error}"
    );
    assert_eq!(error.code(), Code::Internal);
}

/// Without an id, the server could not recognise a retry.
#[tokio::test]
async fn an_empty_operation_id_counts_as_none() {
    let fake = Fake::start().await;
    let index = fake.client().await.index("line").await.unwrap();
    index.insert([[0.0]]).operation_id("").await.unwrap();
    assert!(!fake.insert_requests()[0].operation_id.is_empty());
}
