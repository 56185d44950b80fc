//! A server all of whose connections are taken answers what operators need.

use futures_util::{StreamExt, stream};
use tokio::{sync::oneshot, time::timeout};
use tonic::Code;
use tonic_health::pb::health_check_response::ServingStatus;
use wayfold_tests::{Refusal, Stubs, insert_request, server};

use crate::{health::health, journal_loss::MAX_WAIT};

const CONNECTIONS: usize = 3;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn busy_connections_of_one_address_do_not_close_health_and_administration() {
    let server = server!(; ("WAYFOLD_GRPC__MAX_CONNECTIONS", &CONNECTIONS.to_string()));
    let mut busy = Vec::new();
    for _ in 0..CONNECTIONS {
        let mut stubs = Stubs::connect(server.uri()).await;
        // A stream is a call under way. The client's library ends no connection before it.
        let (end, ended) = oneshot::channel::<()>();
        let requests = stream::pending().take_until(ended);
        let answers = stubs.points.stream_knn(requests).await;
        busy.push((end, answers.unwrap(), stubs));
    }
    let mut guest = Stubs::connect(server.uri()).await;
    guest.create("arm", "R1").await;
    assert_eq!(health(server.uri(), "").await, ServingStatus::Serving);
    let insert = || insert_request("arm", &[0.5], 1);
    let refused = Refusal::of(&guest.points.insert(insert()).await.unwrap_err());
    assert_eq!(refused.code, Code::ResourceExhausted);
    assert_eq!(refused.reason, "TOO_MANY_CALLS");
    busy.pop();
    // The place is free once the server has seen the end of its connection.
    let inserted = async { while guest.points.insert(insert()).await.is_err() {} };
    timeout(MAX_WAIT, inserted).await.expect("a place");
    assert_eq!(guest.describe("arm").await.point_count, 1);
}
