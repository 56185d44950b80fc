//! `StreamKnn`: requests are evaluated side by side, answered in their order, and a bad one does not end the stream.
//!
//! The generated server would: it takes a message that does not parse for the end of the stream. So this one method
//! is served here, with a codec that hands such messages on as what they are.

use std::{panic::AssertUnwindSafe, pin::Pin, sync::Arc, task::Poll, time::Duration};

use bytes::Buf;
use futures_util::{FutureExt, Stream, StreamExt, stream, stream::BoxStream};
use http::{Request, Response};
use prost::{DecodeError, Message};
use tokio_util::task::AbortOnDropHandle;
use tonic::{
    Status,
    body::Body,
    codec::{Codec, DecodeBuf, Decoder},
    server::{Grpc, StreamingService},
};
use tonic_prost::ProstEncoder;
use tracing::Instrument;

use wayfold_proto::v1;

use super::{calls::call_of, refusals};
use crate::{
    latency_gate::LatencyGate,
    lifecycle::PhaseWatch,
    service::{Call, Service},
    status,
};

/// Answers to the requests of one stream, in their order.
pub(crate) type Answers = BoxStream<'static, Result<v1::StreamKnnResponse, Status>>;

/// One message of a stream: a request, or the reason why it is none.
pub(crate) type Incoming = Result<v1::StreamKnnRequest, DecodeError>;

/// As long as searches take less of late, they are not worth a task of their own.
const BRIEF: Duration = Duration::from_micros(20);

/// Serves the streams.
#[derive(Clone)]
pub(crate) struct KnnStreams {
    pub(crate) service: Service,
    pub(crate) phases: PhaseWatch,
    /// How many requests of one stream are evaluated at a time.
    pub(crate) window: usize,
    /// The largest request message that is read.
    pub(crate) max_message_bytes: usize,
}

impl KnnStreams {
    /// Answers a call whose messages have not been parsed yet.
    pub(crate) async fn serve(self, request: Request<Body>) -> Response<Body> {
        let limit = Some(self.max_message_bytes);
        let mut grpc = Grpc::new(TolerantCodec).apply_max_message_size_config(limit, None);
        grpc.streaming(Tolerant(self), request).await
    }

    /// Reads `messages` until they end, the server stops or reading fails; answers what was read, then says why it
    /// ended. At most `window` requests are read ahead of the answers, so that a client who does not read them
    /// is slowed down instead of being buffered for.
    pub(crate) fn answer<M>(&self, call: Call, messages: M) -> Answers
    where
        M: Stream<Item = Result<Incoming, Status>> + Send + Unpin + 'static,
    {
        let reader = Reader {
            messages,
            stopping: Box::pin(self.phases.clone().stopping()),
            max_message_bytes: self.max_message_bytes,
            ended: false,
        };
        let service = self.service.clone();
        let brevity = Arc::new(LatencyGate::new(BRIEF));
        stream::unfold(reader, Reader::next)
            .map(move |read| answer_one(service.clone(), Arc::clone(&brevity), call, read))
            .buffered(self.window)
            .boxed()
    }
}

/// The answer to what was read; an error ends the stream.
async fn answer_one(
    service: Service,
    brevity: Arc<LatencyGate>,
    call: Call,
    read: Read,
) -> Result<v1::StreamKnnResponse, Status> {
    let request = match read {
        Read::Request(request) => request,
        Read::Bad(status) => return Ok(refused(&status)),
        Read::End(status) => return Err(*status),
    };
    // A stream that always has a request at hand lets others on now and then.
    tokio::task::consume_budget().await;
    let search = async move { service.knn(&call, request).await };
    let mut search = Box::pin(AssertUnwindSafe(search).catch_unwind());
    let answered = match brevity.attempt(search.as_mut()) {
        Poll::Ready(answered) => answered,
        Poll::Pending => {
            // A task of its own, so that one stream can keep all cores busy. A stream that is dropped takes its tasks
            // with it.
            let task = AbortOnDropHandle::new(tokio::spawn(search.in_current_span()));
            match task.await {
                Ok(answered) => answered,
                // Only the end of the runtime cancels a task that is waited for.
                Err(_) => return Err(refusals::stopping()),
            }
        }
    };
    Ok(match answered {
        Ok(Ok(answer)) => v1::StreamKnnResponse {
            result: Some(v1::stream_knn_response::Result::Knn(answer)),
        },
        Ok(Err(error)) => refused(&status::from_error(&error)),
        Err(_panic) => refused(&refusals::panicked("PointService/StreamKnn")),
    })
}

fn refused(status: &Status) -> v1::StreamKnnResponse {
    v1::StreamKnnResponse {
        result: Some(v1::stream_knn_response::Result::Error(status::to_message(
            status,
        ))),
    }
}

/// What came of reading one message.
enum Read {
    Request(v1::KnnRequest),
    Bad(Box<Status>),
    End(Box<Status>),
}

struct Reader<M> {
    messages: M,
    stopping: Pin<Box<dyn Future<Output = ()> + Send>>,
    max_message_bytes: usize,
    ended: bool,
}

impl<M: Stream<Item = Result<Incoming, Status>> + Unpin> Reader<M> {
    async fn next(mut self) -> Option<(Read, Self)> {
        if self.ended {
            return None;
        }
        let message = tokio::select! {
            biased;
            () = &mut self.stopping => Some(Err(refusals::stopping())),
            message = self.messages.next() => message,
        };
        let read = match message? {
            Ok(Ok(v1::StreamKnnRequest { knn: Some(request) })) => Read::Request(request),
            Ok(Ok(v1::StreamKnnRequest { knn: None })) => Read::Bad(Box::new(refusals::invalid(
                "knn",
                "REQUIRED",
                "not set, and there is nothing else to ask for".to_owned(),
            ))),
            Ok(Err(error)) => Read::Bad(Box::new(refusals::malformed(&error))),
            Err(status) => {
                // Where a message of the wrong size ends is not known, so nothing can be read after it.
                self.ended = true;
                Read::End(Box::new(refusals::restate(
                    status,
                    self.max_message_bytes,
                    refusals::SPLIT,
                )))
            }
        };
        Some((read, self))
    }
}

struct Tolerant(KnnStreams);

impl StreamingService<Incoming> for Tolerant {
    type Response = v1::StreamKnnResponse;
    type ResponseStream = Answers;
    type Future = std::future::Ready<Result<tonic::Response<Answers>, Status>>;

    fn call(&mut self, request: tonic::Request<tonic::Streaming<Incoming>>) -> Self::Future {
        let call = call_of(&request);
        let answers = self.0.answer(call, request.into_inner());
        std::future::ready(Ok(tonic::Response::new(answers)))
    }
}

struct TolerantCodec;

impl Codec for TolerantCodec {
    type Encode = v1::StreamKnnResponse;
    type Decode = Incoming;
    type Encoder = ProstEncoder<v1::StreamKnnResponse>;
    type Decoder = TolerantDecoder;

    fn encoder(&mut self) -> Self::Encoder {
        ProstEncoder::default()
    }

    fn decoder(&mut self) -> TolerantDecoder {
        TolerantDecoder
    }
}

struct TolerantDecoder;

impl Decoder for TolerantDecoder {
    type Item = Incoming;
    type Error = Status;

    fn decode(&mut self, bytes: &mut DecodeBuf<'_>) -> Result<Option<Incoming>, Status> {
        let message = v1::StreamKnnRequest::decode(&mut *bytes);
        // A message that does not parse leaves bytes behind, and the next one begins after them.
        bytes.advance(bytes.remaining());
        Ok(Some(message))
    }
}
