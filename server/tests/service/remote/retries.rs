//! Retries at another server than the first call.

use wayfold_proto::v1;

use super::{Stream, named_arm, server, settled};
use crate::support::*;

/// The answer may be lost with its server, and the retry must not find what the first call did not.
#[tokio::test]
async fn every_server_remembers_an_operation_that_changed_nothing() {
    let (stream, entry) = (Stream::new(16, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, ..) = server(&stream, &entry);
    one.insert(&CALL, insertion(&[[1.0]], &[7])).await.unwrap();
    let request = v1::InsertRequest {
        min_separation: 0.5,
        operation_id: "close".into(),
        ..insertion(&[[1.1]], &[8])
    };
    let first = one.insert(&CALL, request.clone()).await.unwrap();
    assert_eq!(first.outcomes, [i32::from(v1::Outcome::TooClose)]);
    assert_eq!((first.ids[0], first.revision.number()), (7, 1));
    other.remove(&CALL, removal(&[7])).await.unwrap();
    let (late, ..) = server(&stream, &entry);
    for service in [&other, &late, &one] {
        let again = service.insert(&CALL, request.clone()).await.unwrap();
        assert_eq!(again, first);
    }
    let found = settled(&stream, &entry, &[&one, &other, &late]).await;
    assert!(found.ids.is_empty());
}
