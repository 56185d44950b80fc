//! Bytes that are no message, and messages on a stream that are bad one by one.

use prost::{
    Message,
    bytes::{Buf, BufMut},
};
use tokio_stream::iter;
use tonic::{
    Code::{self, InvalidArgument, NotFound},
    Request, Status,
    client::Grpc,
    codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder},
    codegen::http::uri::PathAndQuery,
    transport::Channel,
};
use wayfold_proto::v1::{
    KnnRequest, StreamKnnRequest, StreamKnnResponse, knn_request::Count,
    stream_knn_response::Result as Answer,
};
use wayfold_tests::row_states;

use super::{Bench, INDEX, good_row};

/// Sends bytes as they are, and returns answers as they are.
#[derive(Clone, Copy, Default)]
struct Raw;

impl Codec for Raw {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Raw;
    type Decoder = Raw;

    fn encoder(&mut self) -> Raw {
        Raw
    }

    fn decoder(&mut self) -> Raw {
        Raw
    }
}

impl Encoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, item: Vec<u8>, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put_slice(&item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let mut item = vec![0; buffer.remaining()];
        buffer.copy_to_slice(&mut item);
        Ok(Some(item))
    }
}

fn path(call: &str) -> PathAndQuery {
    format!("/wayfold.v1.{call}").parse().expect("a path")
}

async fn raw(bench: &Bench) -> Grpc<Channel> {
    let channel = Channel::from_shared(bench._server.uri().to_owned()).expect("a URI");
    let mut grpc = Grpc::new(channel.connect().await.expect("a server"));
    grpc.ready().await.expect("a connection");
    grpc
}

#[tokio::test]
async fn malformed_messages_are_the_callers_fault() {
    let bench = Bench::new().await;
    let mut grpc = raw(&bench).await;
    let expected = (InvalidArgument, "MALFORMED_MESSAGE", "request");
    for call in [
        "IndexService/CreateIndex",
        "PointService/Insert",
        "PointService/Update",
        "PointService/Remove",
        "PointService/Get",
        "PointService/Knn",
        "PointService/Query",
        "PointService/Scan",
    ] {
        for (what, bytes) in [
            ("a wrong wire type", vec![0x08, 0x01]),
            ("a field longer than the message", vec![0x0a, 0x7f, b'x']),
            ("a name that is not UTF-8", vec![0x0a, 0x02, 0xff, 0xfe]),
            ("an endless varint", vec![0xff; 16]),
        ] {
            grpc.ready().await.unwrap();
            let answer = grpc.unary(Request::new(bytes), path(call), Raw).await;
            bench
                .refused(&format!("{what} to {call}"), answer, expected)
                .await;
        }
    }
}

#[tokio::test]
async fn a_call_that_is_none_is_unimplemented() {
    let bench = Bench::new().await;
    let mut grpc = raw(&bench).await;
    for call in ["PointService/Forget", "NoService/Knn"] {
        grpc.ready().await.unwrap();
        let status = grpc.unary(Request::new(vec![]), path(call), Raw).await;
        assert_eq!(status.unwrap_err().code(), Code::Unimplemented, "{call}");
    }
}

#[tokio::test]
async fn a_bad_message_does_not_end_a_stream() {
    let bench = Bench::new().await;
    let mut grpc = raw(&bench).await;
    let knn = |index: &str, k, row: Vec<f64>| {
        let knn = KnnRequest {
            index: index.into(),
            states: Some(row_states(&row, row.len())),
            count: Some(Count::K(k)),
            ..Default::default()
        };
        StreamKnnRequest { knn: Some(knn) }.encode_to_vec()
    };
    let messages = vec![
        (knn(INDEX, 2, good_row()), None),
        (knn(INDEX, 0, good_row()), Some((InvalidArgument, "k"))),
        (vec![0x0a, 0x7f, b'x'], Some((InvalidArgument, "read"))),
        (knn("nowhere", 1, good_row()), Some((NotFound, "nowhere"))),
        (
            knn(INDEX, 1, vec![f64::NAN; 7]),
            Some((InvalidArgument, "states[0].coords[0]")),
        ),
        (vec![], Some((InvalidArgument, "knn"))),
        (
            knn(INDEX, 1, good_row()[..6].to_vec()),
            Some((InvalidArgument, "coordinates")),
        ),
        (knn(INDEX, 3, good_row()), None),
    ];
    let (sent, expected): (Vec<_>, Vec<_>) = messages.into_iter().unzip();
    let stream = Request::new(iter(sent));
    let path = path("PointService/StreamKnn");
    let mut answers = grpc
        .streaming(stream, path, Raw)
        .await
        .unwrap()
        .into_inner();
    for (i, expected) in expected.into_iter().enumerate() {
        let answer = answers
            .message()
            .await
            .unwrap()
            .expect("an answer a message");
        let answer = StreamKnnResponse::decode(answer.as_slice()).unwrap();
        match (answer.result.unwrap(), expected) {
            (Answer::Knn(answer), None) => {
                let counts = answer.neighbors.unwrap().counts;
                assert_eq!(counts, [if i == 0 { 2 } else { 3 }]);
            }
            (Answer::Error(error), Some((code, part))) => {
                assert_eq!(Code::from_i32(error.code), code, "{error:?}");
                assert!(error.message.contains(part), "{error:?}");
                assert!(!error.details.is_empty(), "{error:?}");
            }
            (answer, expected) => panic!("message {i}: {answer:?}, expected {expected:?}"),
        }
    }
    assert_eq!(answers.message().await.unwrap(), None);
}
