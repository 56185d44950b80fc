//! Health and reflection, which strangers may call and no load closes. No budget counts their requests, so few of those of a
//! connection may be on their way: a check of health until it is whole, a watch of health until its client leaves, and a
//! stream for reflection until its requests end, not for long, and until its answers are read. Few streams for reflection
//! of all connections may be open, and few of their bytes wait.

use std::{
    convert::Infallible,
    pin::pin,
    sync::{Arc, OnceLock},
    task::Poll,
    time::Duration,
};

use bytes::{Buf, Bytes, BytesMut};
use futures_util::{StreamExt, poll};
use http::{Request, Response};
use http_body::Frame;
use http_body_util::{BodyExt, Full, StreamBody};
use tokio::{
    sync::{Semaphore, mpsc},
    time::{Instant, sleep_until, timeout},
};
use tokio_stream::wrappers::UnboundedReceiverStream;
use tonic::{Status, body::Body};
use tower::Service;

use super::CallsLayer;
use crate::grpc::{
    MAX_UNAUTHENTICATED_REQUEST_BYTES, body::unread, connections::Activity, refusals,
    request_body::HEADER_BYTES,
};

const REFLECTION: &str = "/grpc.reflection.";

const HEALTH_WATCH: &str = "/grpc.health.v1.Health/Watch";

/// The bytes of a stream for reflection that wait for the service.
const MAX_WAITING_BYTES: usize = 64 * 1024;

/// Each part of these bytes takes this many more in memory.
const PART_BYTES: usize = 64;

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
        let path = request.uri().path();
        let is_stream = path.starts_with(REFLECTION);
        let is_watch = path == HEALTH_WATCH;
        let refused = Arc::new(OnceLock::new());
        let ending = is_stream.then(|| (Arc::clone(&refused), time));
        let mut receiving = pin!(receive(request, ending));
        let mut received = poll!(receiving.as_mut());
        let mut places = None;
        if is_stream || is_watch || received.is_pending() {
            let place = |activity: &Activity| match is_watch {
                true => activity.watching().map(|place| (place, None)),
                false => activity.arriving(is_stream),
            };
            match activity.as_ref().map(place) {
                Some(None) => {
                    admission.count_excess();
                    let refusal = match is_watch {
                        true => refusals::too_many_watching(),
                        false => refusals::too_many_arriving(),
                    };
                    received = Poll::Ready(Err(refusal.into()));
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
        if !is_stream && !is_watch {
            return Ok(response);
        }
        // Its places are free once its answers have ended and are read.
        let counted = move |frame: Frame<Bytes>| {
            let _held = &places;
            match refused.get().filter(|_| frame.is_trailers()) {
                Some(refused) => {
                    admission.count_excess();
                    Frame::trailers(
                        Status::clone(refused)
                            .into_http::<()>()
                            .into_parts()
                            .0
                            .headers,
                    )
                }
                None => frame.map_data(|bytes| unread(bytes, (), activity.as_ref())),
            }
        };
        Ok(response.map(|body| Body::new(body.map_frame(counted))))
    }
}

/// Receives a request whole, unless it is a stream, which is refused later if too much of it waits or it lasts for too long.
async fn receive(
    request: Request<Body>,
    stream: Option<(Arc<OnceLock<Status>>, Duration)>,
) -> Result<Request<Body>, Status> {
    if let Some((refused, time)) = stream {
        return Ok(request.map(|body| read_on(body, refused, time)));
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

/// Reads a stream at once, whether or not the service does, and ends it if too much of it waits, and after `time`. HTTP/2 would
/// keep it, and with each frame of one byte the thousands that it read together with it.
fn read_on(mut body: Body, refused: Arc<OnceLock<Status>>, time: Duration) -> Body {
    let (send, receive) = mpsc::unbounded_channel();
    let room = Arc::new(Semaphore::new(MAX_WAITING_BYTES));
    let end = Instant::now() + time;
    tokio::spawn(async move {
        loop {
            let frame = tokio::select! {
                frame = body.frame() => frame,
                () = send.closed() => return,
                () = sleep_until(end) => {
                    let status = || refusals::too_slow(time).into();
                    Some(Err(refused.get_or_init(status).clone()))
                }
            };
            let part = match frame {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(bytes) => {
                        let bytes = Bytes::copy_from_slice(&bytes);
                        let held = (bytes.len() + PART_BYTES) as u32;
                        let held = Arc::clone(&room).try_acquire_many_owned(held);
                        held.map(|held| (Frame::data(bytes), held)).map_err(|_| {
                            let status = || refusals::too_many_waiting(MAX_WAITING_BYTES).into();
                            // The service ends without an error.
                            Status::clone(refused.get_or_init(status))
                        })
                    }
                    Err(_trailers) => return,
                },
                Some(Err(status)) => Err(status),
                None => return,
            };
            let is_last = part.is_err();
            if send.send(part).is_err() || is_last {
                return;
            }
        }
    });
    let parts = UnboundedReceiverStream::new(receive);
    let read = parts.map(|part: Result<_, Status>| part.map(|(frame, _held)| frame));
    Body::new(StreamBody::new(read))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIME: Duration = Duration::from_secs(60);

    #[tokio::test(start_paused = true)]
    async fn a_stream_that_its_client_does_not_end_is_ended() {
        let sent = futures_util::stream::pending::<Result<Frame<Bytes>, Status>>();
        let refused = Arc::new(OnceLock::new());
        let mut read = read_on(Body::new(StreamBody::new(sent)), Arc::clone(&refused), TIME);
        assert!(timeout(TIME / 2, read.frame()).await.is_err());
        assert!(refused.get().is_none());
        assert!(read.frame().await.unwrap().is_err());
        assert!(read.frame().await.is_none() && refused.get().is_some());
    }

    #[tokio::test]
    async fn a_stream_whose_bytes_wait_is_ended() {
        let (send, receive) = mpsc::channel(1);
        let sent = tokio_stream::wrappers::ReceiverStream::new(receive);
        let refused = Arc::new(OnceLock::new());
        let mut read = read_on(Body::new(StreamBody::new(sent)), Arc::clone(&refused), TIME);
        let part = Bytes::from_static(&[7]);
        let mut parts = 0;
        while send
            .send(Ok::<_, Status>(Frame::data(part.clone())))
            .await
            .is_ok()
        {
            parts += 1;
            assert!(parts <= MAX_WAITING_BYTES / PART_BYTES + 2);
        }
        let mut waiting = 0;
        while let Some(Ok(frame)) = read.frame().await {
            assert_eq!(frame.into_data().unwrap(), part);
            waiting += 1;
        }
        assert_eq!(waiting, MAX_WAITING_BYTES / (PART_BYTES + 1));
        assert_eq!(
            refused.get().unwrap().code(),
            tonic::Code::ResourceExhausted
        );
    }

    #[tokio::test]
    async fn a_stream_that_is_read_goes_on() {
        let (send, receive) = mpsc::channel(1);
        let sent = tokio_stream::wrappers::ReceiverStream::new(receive);
        let mut read = read_on(Body::new(StreamBody::new(sent)), Arc::default(), TIME);
        let part = Bytes::from(vec![7; MAX_WAITING_BYTES / 2]);
        for _ in 0..10 {
            send.send(Ok::<_, Status>(Frame::data(part.clone())))
                .await
                .unwrap();
            assert_eq!(
                read.frame().await.unwrap().unwrap().into_data().unwrap(),
                part
            );
        }
        drop(send);
        assert!(read.frame().await.is_none());
    }
}
