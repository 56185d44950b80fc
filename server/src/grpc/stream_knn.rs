//! `StreamKnn`: requests are evaluated in parallel and answered in order, and a bad one does not end the stream.
//!
//! The generated server ends a stream at a message that does not parse, and holds the buffer of its largest message. So
//! this file serves this one method, and reads its messages with [`MessageReader`].

use std::{
    future::poll_fn, panic::AssertUnwindSafe, pin::Pin, sync::Arc, task::Poll, time::Duration,
};

use futures_util::{FutureExt, StreamExt, stream, stream::BoxStream};
use http::{Request, Response};
use prost::{DecodeError, Message};
use tokio::time::Interval;
use tokio_util::task::AbortOnDropHandle;
use tonic::{
    Status,
    body::Body,
    server::{Grpc, StreamingService},
};
use tonic_prost::ProstCodec;
use tracing::Instrument;

use wayfold_proto::v1;

use super::{
    calls::{call_of, caller_checks, check_caller, flow_of},
    message_reader::MessageReader,
    refusals::{self, MessageLimit},
};
use crate::{
    admission::{Admission, Flow, HeldBytes},
    faces::panicked,
    latency_gate::LatencyGate,
    lifecycle::PhaseWatch,
    service::{Call, Service},
    status::{Status as Refusal, from_error, overloaded, too_many_bytes},
};

/// Answers to the requests of one stream, in their order.
pub(crate) type Answers = BoxStream<'static, Result<v1::StreamKnnResponse, Status>>;

/// The messages of one stream: each is a request, or its refusal.
type Messages = BoxStream<'static, Result<Result<v1::StreamKnnRequest, DecodeError>, Status>>;

/// While recent searches take less time, they do not get tasks of their own.
const MAX_SEARCH_TIME: Duration = Duration::from_micros(20);

/// Serves the streams.
#[derive(Clone)]
pub(crate) struct KnnStreams {
    pub(crate) service: Service,
    pub(crate) admission: Admission,
    pub(crate) phases: PhaseWatch,
    /// Requests of one stream that are evaluated at a time.
    pub(crate) window: usize,
    /// The largest request message that is read.
    pub(crate) max_message_bytes: usize,
}

impl KnnStreams {
    /// Answers a call whose messages are not parsed yet.
    pub(crate) async fn serve(self, request: Request<Body>) -> Response<Body> {
        let (parts, body) = request.into_parts();
        let reader = MessageReader::new(body, self.max_message_bytes);
        let messages = stream::unfold(reader, async |mut reader| {
            let message = reader.next().await?;
            Some((message.map(v1::StreamKnnRequest::decode), reader))
        });
        let stream = TolerantStreamKnn {
            streams: self,
            messages: Some(messages.boxed()),
        };
        // Tonic makes the answers only.
        let request = Request::from_parts(parts, Body::empty());
        Grpc::new(ProstCodec::default())
            .streaming(stream, request)
            .await
    }

    /// Reads `messages` until they end, the server stops or a read fails; answers those read, then sends the cause of
    /// the end. It reads at most `window` requests ahead of the answers: a client that reads no answers is slowed down,
    /// not buffered for.
    fn answer(&self, call: Call, flow: Arc<Flow>, messages: Messages) -> Answers {
        let reader = Reader {
            messages,
            call: call.clone(),
            checks: caller_checks(),
            stopping: Box::pin(self.phases.clone().stopping()),
            max_message_bytes: self.max_message_bytes,
            ended: false,
        };
        let unread = UnreadAnswers {
            service: self.service.clone(),
            flow: Arc::clone(&flow),
            others: Arc::new(()),
        };
        let searches = Searches {
            service: self.service.clone(),
            flow,
            latency_gate: Arc::new(LatencyGate::new(MAX_SEARCH_TIME)),
        };
        stream::unfold(reader, Reader::next)
            .then(move |read| unread.clone().hold(read))
            .map(move |(read, held)| {
                let answered = searches.clone().answer(call.clone(), read);
                answered.map(move |answer| (answer, held))
            })
            .buffered(self.window)
            .map(|(answer, _held)| answer)
            .boxed()
    }
}

/// The bytes of answers by which a stream is ahead of its client.
#[derive(Clone)]
struct UnreadAnswers {
    service: Service,
    flow: Arc<Flow>,
    /// A clone for each request that is evaluated.
    others: Arc<()>,
}

impl UnreadAnswers {
    /// Waits for room for the answer to a request. The room is given back as the answer leaves the stream, where it
    /// counts as unread.
    async fn hold(self, read: ReadOutcome) -> (ReadOutcome, (HeldBytes, Arc<()>)) {
        let (held, others) = (self.flow.hold(), self.others);
        let ReadOutcome::Request(request) = &read else {
            return (read, (held, others));
        };
        // It holds the request until it has the answer.
        let answer = self.service.most_answer_bytes(request);
        let bytes = answer.max(request.encoded_len());
        let taken = poll_fn(|_| match held.try_take(bytes) {
            true => Poll::Ready(true),
            // One clone is this one's, and one the stream's. No answer is left that could make room.
            false if Arc::strong_count(&others) <= 2 => Poll::Ready(held.take(bytes)),
            // The stream polls this again after another answer has left it.
            false => Poll::Pending,
        });
        let read = match taken.await {
            true => read,
            false => ReadOutcome::Bad(Box::new(too_many_bytes(self.flow.max_bytes()))),
        };
        (read, (held, others))
    }
}

/// The searches of one stream.
#[derive(Clone)]
struct Searches {
    service: Service,
    flow: Arc<Flow>,
    latency_gate: Arc<LatencyGate>,
}

impl Searches {
    /// The answer to one message; an error ends the stream.
    async fn answer(self, call: Call, read: ReadOutcome) -> Result<v1::StreamKnnResponse, Status> {
        let Self {
            service,
            flow,
            latency_gate,
        } = self;
        let request = match read {
            ReadOutcome::Request(request) => request,
            ReadOutcome::Bad(status) => return Ok(refused(&status)),
            ReadOutcome::End(status) => return Err(*status),
        };
        // A stream that always has a request ready yields now and then.
        tokio::task::consume_budget().await;
        let search = async move { service.knn(&call, request).await };
        let mut search = Box::pin(AssertUnwindSafe(search).catch_unwind());
        let answered = match latency_gate.attempt(search.as_mut()) {
            Poll::Ready(answered) => answered,
            Poll::Pending => {
                // A task of its own: one stream can use all cores. A dropped stream aborts its tasks.
                let in_turns = async move { flow.turns_of_stream().run(search).await };
                let task = AbortOnDropHandle::new(tokio::spawn(in_turns.in_current_span()));
                match task.await {
                    Ok(Ok(answered)) => answered,
                    Ok(Err(late)) => return Ok(refused(&overloaded(late))),
                    // Only the end of the runtime cancels an awaited task.
                    Err(_) => return Err(refusals::stopping().into()),
                }
            }
        };
        Ok(match answered {
            Ok(Ok(answer)) => v1::StreamKnnResponse {
                result: Some(v1::stream_knn_response::Result::Knn(answer)),
            },
            Ok(Err(error)) => refused(&from_error(&error)),
            Err(_panic) => refused(&panicked("PointService/StreamKnn")),
        })
    }
}

fn refused(status: &Refusal) -> v1::StreamKnnResponse {
    v1::StreamKnnResponse {
        result: Some(v1::stream_knn_response::Result::Error(status.to_message())),
    }
}

/// The result of reading one message.
enum ReadOutcome {
    Request(v1::KnnRequest),
    Bad(Box<Refusal>),
    End(Box<Status>),
}

struct Reader {
    messages: Messages,
    call: Call,
    /// A stream ends with the rights of its caller, also without a request.
    checks: Interval,
    stopping: Pin<Box<dyn Future<Output = ()> + Send>>,
    max_message_bytes: usize,
    ended: bool,
}

impl Reader {
    async fn next(mut self) -> Option<(ReadOutcome, Self)> {
        if self.ended {
            return None;
        }
        let message = loop {
            tokio::select! {
                biased;
                () = &mut self.stopping => break Some(Err(refusals::stopping().into())),
                message = self.messages.next() => break message,
                _ = self.checks.tick() => {
                    if let Err(status) = check_caller(&self.call) {
                        break Some(Err(status));
                    }
                }
            }
        };
        let read = match message? {
            Ok(Ok(v1::StreamKnnRequest { knn: Some(request) })) => ReadOutcome::Request(request),
            Ok(Ok(v1::StreamKnnRequest { knn: None })) => {
                ReadOutcome::Bad(Box::new(refusals::invalid(
                    "knn",
                    "REQUIRED",
                    "not set, and there is nothing else to ask for".to_owned(),
                )))
            }
            Ok(Err(error)) => ReadOutcome::Bad(Box::new(refusals::malformed(&error))),
            Err(status) => {
                // The end of a message of the wrong size is unknown: nothing can be read after it.
                self.ended = true;
                ReadOutcome::End(Box::new(refusals::restate(
                    status,
                    MessageLimit::of_setting(self.max_message_bytes),
                    refusals::SPLIT,
                )))
            }
        };
        Some((read, self))
    }
}

struct TolerantStreamKnn {
    streams: KnnStreams,
    /// Taken by the only call.
    messages: Option<Messages>,
}

impl StreamingService<v1::StreamKnnRequest> for TolerantStreamKnn {
    type Response = v1::StreamKnnResponse;
    type ResponseStream = Answers;
    type Future = std::future::Ready<Result<tonic::Response<Answers>, Status>>;

    fn call(
        &mut self,
        request: tonic::Request<tonic::Streaming<v1::StreamKnnRequest>>,
    ) -> Self::Future {
        // It has a flow of its own if the layer around all calls is missing.
        let flow = flow_of(&request).unwrap_or_else(|| self.streams.admission.open());
        let messages = self.messages.take();
        let messages = messages.unwrap_or_else(|| stream::empty().boxed());
        let answers = self.streams.answer(call_of(&request), flow, messages);
        std::future::ready(Ok(tonic::Response::new(answers)))
    }
}

#[cfg(test)]
mod tests {
    use futures_util::poll;

    use super::*;
    use crate::config::Config;

    fn unread(admission: &Admission) -> UnreadAnswers {
        UnreadAnswers {
            service: Service::starting(Default::default()),
            flow: admission.open(),
            others: Arc::new(()),
        }
    }

    fn refused(admission: &Admission) -> u64 {
        let of_bytes = |(reason, calls)| (reason == "TOO_MANY_BYTES").then_some(calls);
        admission.refused(0).into_iter().find_map(of_bytes).unwrap()
    }

    #[tokio::test]
    async fn a_stream_that_waits_for_room_counts_no_refusal() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let unread = unread(&admission);
        // Without k, an answer may have any size.
        let hold = || {
            unread
                .clone()
                .hold(ReadOutcome::Request(v1::KnnRequest::default()))
        };
        let mut held = Vec::new();
        let mut next = loop {
            let mut next = Box::pin(hold());
            match poll!(next.as_mut()) {
                Poll::Ready((_, first)) => held.push(first),
                Poll::Pending => break next,
            }
            assert!(held.len() < 10_000);
        };
        assert!(poll!(next.as_mut()).is_pending());
        assert_eq!(refused(&admission), 0);
        // Nothing of its own stream is left that could make room: it is refused.
        let all: Vec<_> = held.into_iter().map(|(held, _other)| held).collect();
        let (read, _) = next.await;
        assert!(matches!(read, ReadOutcome::Bad(_)));
        assert_eq!(refused(&admission), 1);
        drop(all);
    }

    #[tokio::test]
    async fn a_request_that_is_evaluated_holds_its_bytes() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let unread = unread(&admission);
        let request = v1::KnnRequest {
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![0.5; 100_000],
            }),
            k_form: Some(v1::knn_request::KForm::K(1)),
            ..Default::default()
        };
        let (_read, _held) = unread.hold(ReadOutcome::Request(request)).await;
        assert!(admission.bytes().0 > 800_000);
    }
}
