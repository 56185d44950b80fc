//! `StreamKnn`: answers come in the order of the requests, and a bad request costs its own answer only.

use crate::{
    harness::{TestServer, knn, nearest, reason},
    raw::Raw,
};
use futures_util::{StreamExt, stream};
use http::uri::PathAndQuery;
use prost::Message;
use tonic::{Code, Request, Status};
use tonic_types::pb;
use wayfold_proto::v1::{self, stream_knn_response::Result as Answer};

const COUNT: u64 = 100;

fn request(knn: v1::KnnRequest) -> v1::StreamKnnRequest {
    v1::StreamKnnRequest { knn: Some(knn) }
}

/// The status inside an answer, as a failed call would return it.
fn error(answer: v1::StreamKnnResponse) -> Status {
    match answer.result.unwrap() {
        Answer::Knn(answer) => panic!("{answer:?}"),
        Answer::Error(status) => {
            let code = Code::from_i32(status.code);
            let details = pb::Status {
                code: status.code,
                message: status.message.clone(),
                details: status.details,
            };
            Status::with_details(code, status.message, details.encode_to_vec().into())
        }
    }
}

#[tokio::test]
async fn answers_come_in_the_order_of_the_requests() {
    let server = TestServer::start(|config| config.grpc.stream_window = 4).await;
    server.create_ruler("line", COUNT).await;
    // Long and short requests alternate, so an answer is ready before the one that precedes it.
    let requests = stream::iter(0..COUNT).map(|at| {
        let rows = if at % 2 == 0 { 2000 } else { 1 };
        request(knn("line", &vec![at as f64; rows], 1))
    });
    let answers = server.points().stream_knn(requests).await.unwrap();
    let answers: Vec<u64> = answers
        .into_inner()
        .map(|answer| nearest(answer.unwrap()))
        .collect()
        .await;
    assert_eq!(answers, (0..COUNT).collect::<Vec<_>>());
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_bad_request_is_answered_with_its_error_and_does_not_end_the_stream() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", COUNT).await;
    let mut wide = knn("line", &[2.0], 1);
    wide.states.as_mut().unwrap().coordinates.push(2.0);
    let requests = vec![
        request(knn("line", &[1.0], 1)),
        request(knn("line", &[f64::NAN], 1)),
        request(knn("none", &[1.0], 1)),
        v1::StreamKnnRequest { knn: None },
        request(knn("line", &[2.0], 0)),
        request(wide),
        request(knn("line", &[3.0], 1)),
    ];
    let answers = server.points().stream_knn(stream::iter(requests)).await;
    let mut answers = answers.unwrap().into_inner();
    let mut next = async || answers.message().await.unwrap().unwrap();
    assert_eq!(nearest(next().await), 1);
    let wrong_number = error(next().await);
    assert_eq!(reason(&wrong_number, Code::InvalidArgument), "NAN");
    let no_index = error(next().await);
    assert_eq!(reason(&no_index, Code::NotFound), "INDEX_NOT_FOUND");
    let empty = error(next().await);
    assert_eq!(reason(&empty, Code::InvalidArgument), "REQUIRED");
    let no_k = error(next().await);
    assert_eq!(reason(&no_k, Code::InvalidArgument), "ZERO");
    let wide = error(next().await);
    assert_eq!(reason(&wide, Code::InvalidArgument), "WIDTH");
    assert_eq!(nearest(next().await), 3);
    assert!(answers.message().await.unwrap().is_none());
    server.stop().await.unwrap().unwrap();
}

/// Sends messages as the bytes they are.
async fn raw(
    server: &TestServer,
    messages: Vec<Vec<u8>>,
) -> impl StreamExt<Item = Result<v1::StreamKnnResponse, Status>> + Unpin + use<> {
    let mut client = tonic::client::Grpc::new(server.channel.clone());
    client.ready().await.unwrap();
    let path = PathAndQuery::from_static("/wayfold.v1.PointService/StreamKnn");
    let request = Request::new(stream::iter(messages));
    let answers = client.streaming(request, path, Raw).await.unwrap();
    answers
        .into_inner()
        .map(|bytes| bytes.map(|bytes| v1::StreamKnnResponse::decode(&*bytes).unwrap()))
}

#[tokio::test]
async fn a_message_that_does_not_parse_does_not_end_the_stream() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", COUNT).await;
    let good = |at: f64| request(knn("line", &[at], 1)).encode_to_vec();
    let mut cut_short = good(5.0);
    cut_short.pop();
    let messages = vec![good(1.0), vec![0x0f], cut_short, good(2.0)];
    let mut answers = raw(&server, messages).await;
    assert_eq!(nearest(answers.next().await.unwrap().unwrap()), 1);
    for _ in 0..2 {
        let status = error(answers.next().await.unwrap().unwrap());
        let reason = reason(&status, Code::InvalidArgument);
        assert_eq!(reason, "MALFORMED_MESSAGE");
    }
    assert_eq!(nearest(answers.next().await.unwrap().unwrap()), 2);
    assert!(answers.next().await.is_none());
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_message_that_is_too_large_ends_the_stream_after_the_answers_before_it() {
    let server = TestServer::start(|config| config.grpc.max_message_bytes = 1000).await;
    server.create_ruler("line", 50).await;
    let good = |at: f64| request(knn("line", &[at], 1)).encode_to_vec();
    let messages = vec![good(1.0), good(2.0), vec![0; 1001], good(3.0)];
    let mut answers = raw(&server, messages).await;
    assert_eq!(nearest(answers.next().await.unwrap().unwrap()), 1);
    assert_eq!(nearest(answers.next().await.unwrap().unwrap()), 2);
    let status = answers.next().await.unwrap().unwrap_err();
    assert_eq!(reason(&status, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    let text = "grpc.max_message_bytes = 1000";
    assert!(status.message().contains(text), "{status}");
    server.stop().await.unwrap().unwrap();
}
