//! Health and reflection, which strangers may call and no load closes. No budget counts their requests, so few of those of a
//! connection may be on their way, and not for long.

use std::{convert::Infallible, future::ready, pin::pin, task::Poll};

use bytes::BytesMut;
use futures_util::{StreamExt, poll, stream};
use http::{Request, Response};
use http_body::Frame;
use http_body_util::{BodyExt, BodyStream, StreamBody};
use tokio::time::timeout;
use tonic::{Status, body::Body};
use tower::Service;

use super::CallsLayer;
use crate::grpc::{
    MAX_OPEN_REQUEST_BYTES,
    connections::{Activity, MAX_ARRIVING},
    refusals,
    request_body::{HEADER_BYTES, Messages},
};

const REFLECTION: &str = "/grpc.reflection.";

/// True for the paths of health and reflection.
pub(super) fn is_open(path: &str) -> bool {
    path.starts_with("/grpc.health.") || path.starts_with(REFLECTION)
}

/// Answers a request once it has arrived.
pub(super) fn answer<S>(
    mut inner: S,
    request: Request<Body>,
    settings: &CallsLayer,
) -> impl Future<Output = Result<Response<Body>, Infallible>> + use<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
{
    let (time, admission) = (settings.requests.time, settings.shared.admission.clone());
    let activity = request.extensions().get::<Activity>().cloned();
    async move {
        let received = {
            let mut receiving = pin!(receive(request));
            match poll!(receiving.as_mut()) {
                Poll::Ready(received) => received,
                Poll::Pending => match activity.as_ref().map(Activity::arriving) {
                    Some(None) => {
                        admission.count_excess();
                        Err(refusals::too_many_arriving(MAX_ARRIVING).into())
                    }
                    _place => {
                        let received = timeout(time, receiving).await;
                        received.unwrap_or_else(|_| Err(refusals::too_slow(time).into()))
                    }
                },
            }
        };
        match received {
            Ok(request) => inner.call(request).await,
            Err(status) => Ok(status.into_http()),
        }
    }
}

/// Receives a request: whole, or up to its first message if it is a stream.
async fn receive(request: Request<Body>) -> Result<Request<Body>, Status> {
    let is_stream = request.uri().path().starts_with(REFLECTION);
    let (parts, mut body) = request.into_parts();
    let (mut messages, mut received) = (Messages::default(), BytesMut::new());
    while let Some(frame) = body.frame().await {
        if let Some(bytes) = frame?.data_ref() {
            messages.advance(bytes);
            received.extend_from_slice(bytes);
        }
        // The service refuses a message that is too large at its header.
        if messages.length > MAX_OPEN_REQUEST_BYTES || is_stream && messages.ended > 0 {
            break;
        }
        if received.len() > HEADER_BYTES + MAX_OPEN_REQUEST_BYTES {
            return Err(refusals::malformed("another one follows it").into());
        }
    }
    let received = stream::once(ready(Ok(Frame::data(received.freeze()))));
    let body = StreamBody::new(received.chain(BodyStream::new(body)));
    Ok(Request::from_parts(parts, Body::new(body)))
}
