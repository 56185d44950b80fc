//! A stream for reflection, which strangers may open. Its requests are read as they come and wait here, in few bytes: those
//! that the service does not read would fill the window of HTTP/2, which no budget counts. The service gets one at a time,
//! and the next one once the client has taken the answer before.

use std::{convert::Infallible, sync::Arc, time::Duration};

use bytes::{Buf, Bytes, BytesMut};
use futures_util::stream;
use http::{HeaderMap, HeaderValue, Method, Request, Response, Uri, header};
use http_body::Frame;
use http_body_util::{BodyExt, Full, StreamBody};
use tokio::sync::{
    OwnedSemaphorePermit, Semaphore,
    mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel},
};
use tokio::time::timeout;
use tokio_util::task::AbortOnDropHandle;
use tonic::{Code, Status, body::Body};
use tower::Service;

use crate::grpc::{
    MAX_UNAUTHENTICATED_REQUEST_BYTES,
    body::{AnswerFrame, unread},
    connections::Activity,
    refusals,
    request_body::HEADER_BYTES,
};

/// The bytes that a waiting request takes beside its own.
const REQUEST_OVERHEAD: usize = 64;

/// The most bytes of the requests of one stream that wait: one of the largest.
const MAX_WAITING_BYTES: usize =
    HEADER_BYTES + MAX_UNAUTHENTICATED_REQUEST_BYTES + REQUEST_OVERHEAD;

/// A request that waits, and its room.
type Waiting = (Bytes, OwnedSemaphorePermit);

/// The conversation of one stream.
struct Conversation<S> {
    inner: S,
    uri: Uri,
    requests: UnboundedReceiver<Waiting>,
    /// Reads the requests.
    reading: AbortOnDropHandle<Result<(), Status>>,
    /// The answer to the last request, until its end, and whether it had a message.
    answer: Option<(Body, bool)>,
    activity: Option<Activity>,
    /// The longest wait for a turn.
    time: Duration,
    /// The turn of the answer, which goes on with it until it is read.
    turn: Option<OwnedSemaphorePermit>,
    /// The place of the stream, until its last answer is taken.
    _place: Option<OwnedSemaphorePermit>,
}

/// Answers the requests of a stream, which keeps its `place`. The stream ends if an answer of another one of the
/// connection stays unread for `time`.
pub(super) fn converse<S>(
    inner: S,
    request: Request<Body>,
    place: Option<OwnedSemaphorePermit>,
    time: Duration,
) -> Response<Body>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible> + Send + 'static,
    S::Future: Send + 'static,
{
    let (parts, body) = request.into_parts();
    let (sender, requests) = unbounded_channel();
    let conversation = Conversation {
        inner,
        uri: parts.uri,
        requests,
        reading: AbortOnDropHandle::new(tokio::spawn(read(body, sender))),
        answer: None,
        activity: parts.extensions.get().cloned(),
        time,
        turn: None,
        _place: place,
    };
    let answers = stream::unfold(Some(conversation), async |conversation| {
        let mut conversation = conversation?;
        match conversation.next().await {
            Ok(frame) => Some((Ok(frame), Some(conversation))),
            Err(end) => Some((trailers(&end), None)),
        }
    });
    let mut response = Response::new(Body::new(StreamBody::new(answers)));
    let grpc = HeaderValue::from_static("application/grpc");
    response.headers_mut().insert(header::CONTENT_TYPE, grpc);
    response
}

impl<S> Conversation<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    /// The next part of an answer, or the status at the end.
    async fn next(&mut self) -> Result<Frame<Bytes>, Status> {
        loop {
            if let Some((answer, has_message)) = &mut self.answer {
                match answer.frame().await.transpose()?.map(Frame::into_data) {
                    Some(Ok(bytes)) => {
                        *has_message = true;
                        let bytes = unread(bytes, self.turn.take(), self.activity.as_ref());
                        return Ok(Frame::data(bytes));
                    }
                    Some(Err(frame)) => refused(frame.trailers_ref())?,
                    // The service ends a stream at a request that it cannot read, and names no error.
                    None if !*has_message => return Err(Status::ok("")),
                    None => self.answer = None,
                }
                continue;
            }
            let Some((request, _room)) = self.requests.recv().await else {
                let ended = (&mut self.reading).await;
                return Err(ended
                    .unwrap_or(Ok(()))
                    .err()
                    .unwrap_or_else(|| Status::ok("")));
            };
            if let Some(activity) = &self.activity {
                let turn = timeout(self.time, activity.reflect()).await;
                self.turn = turn.map_err(|_| refusals::reflection_unread())?;
            }
            let mut request = Request::new(Body::new(Full::new(request)));
            *request.method_mut() = Method::POST;
            *request.uri_mut() = self.uri.clone();
            let response = match self.inner.call(request).await {
                Ok(response) => response,
                Err(never) => match never {},
            };
            refused(Some(response.headers()))?;
            self.answer = Some((response.into_body(), false));
        }
    }
}

/// Fails with the status in these headers or trailers, if they have one that is no success.
fn refused(headers: Option<&HeaderMap>) -> Result<(), Status> {
    let status = headers.and_then(Status::from_header_map);
    match status.filter(|status| status.code() != Code::Ok) {
        Some(status) => Err(status),
        None => Ok(()),
    }
}

fn trailers(status: &Status) -> AnswerFrame {
    let mut trailers = HeaderMap::new();
    status.add_header(&mut trailers)?;
    Ok(Frame::trailers(trailers))
}

/// Reads requests until they end, or until more wait than may.
async fn read(mut body: Body, requests: UnboundedSender<Waiting>) -> Result<(), Status> {
    let room = Arc::new(Semaphore::new(MAX_WAITING_BYTES));
    let wait = |request: Bytes| {
        let bytes = (request.len() + REQUEST_OVERHEAD) as u32;
        let held = Arc::clone(&room).try_acquire_many_owned(bytes);
        let held = held.map_err(|_| refusals::too_many_waiting(MAX_WAITING_BYTES))?;
        // Without a receiver the stream has ended.
        let _ = requests.send((request, held));
        Ok::<_, Status>(())
    };
    let mut arrived = BytesMut::new();
    while let Some(frame) = body.frame().await {
        arrived.extend_from_slice(&frame?.into_data().unwrap_or_default());
        while let Some(request) = take(&mut arrived) {
            wait(request)?;
        }
        // A rest would keep the buffer of what came with it.
        arrived = BytesMut::from(&arrived[..]);
    }
    match arrived.is_empty() {
        true => Ok(()),
        // The service refuses a part of a message.
        false => wait(arrived.freeze()),
    }
}

/// The first request if it is whole, in a buffer of its own. The service refuses one that is too large at its header.
fn take(arrived: &mut BytesMut) -> Option<Bytes> {
    let length = arrived.get(1..HEADER_BYTES)?.get_u32() as usize;
    let end = match length > MAX_UNAUTHENTICATED_REQUEST_BYTES {
        true => HEADER_BYTES,
        false => HEADER_BYTES + length,
    };
    (arrived.len() >= end).then(|| Bytes::copy_from_slice(&arrived.split_to(end)))
}
