//! Health and reflection, which strangers may call and no load closes. No budget counts their requests, so few of those of a
//! connection may be on their way: a request for health until it is whole, and not for long, and a stream for reflection
//! for as long as its client likes, and until its answers are read. Few streams for reflection of all connections may be
//! open: HTTP/2 keeps the requests that the service has not read.

use std::{convert::Infallible, pin::pin, task::Poll};

use bytes::{Buf, Bytes, BytesMut};
use futures_util::poll;
use http::{Request, Response};
use http_body::Frame;
use http_body_util::{BodyExt, Full};
use tokio::time::timeout;
use tonic::{Status, body::Body};
use tower::Service;

use super::CallsLayer;
use crate::grpc::{
    MAX_UNAUTHENTICATED_REQUEST_BYTES, body::unread, connections::Activity, refusals,
    request_body::HEADER_BYTES,
};

const REFLECTION: &str = "/grpc.reflection.";

/// True for the paths of health and reflection.
pub(super) fn is_unauthenticated(path: &str) -> bool {
    path.starts_with("/grpc.health.") || path.starts_with(REFLECTION)
}

/// Answers a request: one for health once it has arrived.
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
        let is_stream = request.uri().path().starts_with(REFLECTION);
        let mut receiving = pin!(receive(request, is_stream));
        let mut received = poll!(receiving.as_mut());
        let mut places = None;
        if is_stream || received.is_pending() {
            match activity.as_ref().map(|it| it.arriving(is_stream)) {
                Some(None) => {
                    admission.count_excess();
                    received = Poll::Ready(Err(refusals::too_many_arriving().into()));
                }
                held => places = held.flatten(),
            }
        }
        let received = match received {
            Poll::Ready(received) => received,
            Poll::Pending => timeout(time, receiving).await.unwrap_or_else(|_| {
                if let Some(activity) = &activity {
                    activity.flow().count_slow();
                }
                Err(refusals::too_slow(time).into())
            }),
        };
        let request = match received {
            Ok(request) => request,
            Err(status) => return Ok(status.into_http()),
        };
        let response = inner.call(request).await?;
        if !is_stream {
            return Ok(response);
        }
        // Its places are free once its answers are read.
        let counted = move |frame: Frame<Bytes>| {
            let _held = &places;
            frame.map_data(|bytes| unread(bytes, (), activity.as_ref()))
        };
        Ok(response.map(|body| Body::new(body.map_frame(counted))))
    }
}

/// Receives a request whole, unless it is a stream.
async fn receive(request: Request<Body>, is_stream: bool) -> Result<Request<Body>, Status> {
    if is_stream {
        return Ok(request);
    }
    let (parts, mut body) = request.into_parts();
    let mut whole = BytesMut::new();
    while let Some(frame) = body.frame().await {
        if let Some(bytes) = frame?.data_ref() {
            whole.extend_from_slice(bytes);
        }
        // The service refuses a message that is too large at its header.
        let length = whole.get(1..HEADER_BYTES).map(|mut it| it.get_u32());
        let length = length.map_or(whole.len(), |length| whole.len().max(length as usize));
        if length > MAX_UNAUTHENTICATED_REQUEST_BYTES {
            break;
        }
    }
    Ok(Request::from_parts(
        parts,
        Body::new(Full::new(whole.freeze())),
    ))
}
