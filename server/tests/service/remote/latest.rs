//! Reads with `latest` at one of two servers that share a journal.

use wayfold_proto::v1;
use wayfold_server::service::Code;

use super::{Stream, named_arm, server};
use crate::support::*;

/// Each server reads what the other has just acknowledged. Without `latest` it may lag behind.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_latest_read_sees_what_another_server_acknowledged() {
    let (stream, entry) = (Stream::new(11, 0.1), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, ..) = server(&stream, &entry);
    for number in 0..30u64 {
        let (writer, reader) = match number % 2 {
            0 => (&one, &other),
            _ => (&other, &one),
        };
        let inserted = writer
            .insert(&CALL, insertion(&[[number as f64]], &[]))
            .await;
        let id = inserted.unwrap().ids[0];
        let reads = (0..4).map(|_| {
            let request = v1::GetRequest {
                latest: true,
                ..getting(&[id])
            };
            let reader = reader.clone();
            tokio::spawn(async move { reader.get(&CALL, request).await })
        });
        for read in reads.collect::<Vec<_>>() {
            assert!(read.await.unwrap().is_ok(), "insert {number}");
        }
    }
}

/// A server that gets no records cannot tell, and does not answer from the past. Nothing makes it read the stream itself.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_latest_read_fails_at_a_server_that_gets_no_records() {
    let (stream, entry) = (Stream::new(12, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, _, behind) = server(&stream, &entry);
    behind.fall_behind();
    one.insert(&CALL, insertion(&[[100.0]], &[])).await.unwrap();
    let request = v1::GetRequest {
        latest: true,
        ..getting(&[])
    };
    let error = other.get(&CALL, request).await.unwrap_err();
    assert_eq!(error.code(), Code::Unavailable, "{error}");
}
