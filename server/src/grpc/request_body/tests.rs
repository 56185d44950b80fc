//! Requests that arrive in frames of any size.

use bytes::{BufMut, BytesMut};
use futures_util::{StreamExt, stream};
use http_body_util::StreamBody;
use proptest::prelude::*;
use tokio::time::timeout;

use super::*;
use crate::{admission::Admission, config::Config};

fn request(frames: Vec<Bytes>, is_stream: bool) -> RequestBody {
    let frames = frames
        .into_iter()
        .map(|bytes| Ok::<_, Status>(Frame::data(bytes)));
    let inner = Body::new(StreamBody::new(stream::iter(frames)));
    let limits = RequestLimits {
        message: MessageLimit::of_setting(1000),
        time: Duration::from_secs(60),
        may_pause: false,
    };
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let (held, now) = (Arc::new(admission.open().hold()), Instant::now());
    let service = Service::starting(Default::default());
    RequestBody::new(inner, limits, held, None, is_stream, now, service)
}

async fn whole_of(frames: Vec<Bytes>) -> Result<Bytes, Status> {
    request(frames, false).whole().await
}

#[tokio::test(start_paused = true)]
async fn a_stream_that_may_not_pause_ends_after_its_time() {
    let message = Bytes::from_static(&[0, 0, 0, 0, 0]);
    for may_pause in [false, true] {
        let mut stream = request(vec![message.clone()], true);
        let sent = stream::iter([Ok::<_, Status>(Frame::data(message.clone()))]);
        stream.inner = Body::new(StreamBody::new(sent.chain(stream::pending())));
        stream.limits.may_pause = may_pause;
        assert!(stream.frame().await.unwrap().is_ok());
        let next = timeout(2 * stream.limits.time, stream.frame()).await;
        assert_eq!(next.is_err(), may_pause);
        if let Ok(ended) = next {
            let code = ended.unwrap().unwrap_err().code();
            assert_eq!(code, tonic::Code::ResourceExhausted);
        }
    }
}

#[tokio::test]
async fn a_stream_that_may_not_pause_holds_its_largest_message_to_its_end() {
    let message = |length: u8| {
        let mut message = BytesMut::from(&[0, 0, 0, 0, length][..]);
        message.put_bytes(7, length.into());
        message.freeze()
    };
    for (may_pause, expected) in [(false, 105), (true, 0)] {
        let mut stream = request(vec![message(100), message(10)], true);
        stream.limits.may_pause = may_pause;
        for _ in 0..2 {
            stream.frame().await.unwrap().unwrap();
            assert_eq!(stream.held.flow().held(), expected);
        }
    }
}

/// Hyper reports no error for some resets: the body is over, and not at its end.
#[tokio::test]
async fn a_stream_that_is_reset_has_not_ended() {
    let mut stream = request(vec![Bytes::from_static(&[0, 0, 0, 0, 0])], true);
    assert!(stream.frame().await.unwrap().is_ok());
    assert!(stream.frame().await.unwrap().is_err());
}

/// Frames of one byte would hold more than thirty times what they count.
#[tokio::test]
async fn a_whole_request_holds_none_of_its_frames() {
    let mut sent = BytesMut::new();
    sent.put_slice(&[0, 0, 0, 0, 100]);
    sent.put_bytes(7, 100);
    let sent = sent.freeze();
    let frames = (0..sent.len()).map(|at| sent.slice(at..at + 1));
    let whole = whole_of(frames.collect()).await.unwrap();
    assert_eq!(whole, sent);
    assert!(sent.is_unique());
}

#[tokio::test]
async fn a_second_message_is_refused() {
    let message = Bytes::from_static(&[0, 0, 0, 0, 1, 7]);
    whole_of(vec![message.clone()]).await.unwrap();
    for rest in [message.clone(), message.slice(..1)] {
        let refused = whole_of(vec![message.clone(), rest]).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::InvalidArgument);
    }
}

proptest! {
    #![proptest_config(crate::testing::cases(200))]

    #[test]
    fn what_has_arrived_is_kept_in_order_and_with_few_spare_bytes(
        frames in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..3_000), 1..200),
    ) {
        let mut arrived = Arrived::default();
        for (at, frame) in frames.iter().enumerate() {
            arrived.push(frame);
            let length: usize = frames[..=at].iter().map(Vec::len).sum();
            let kept: usize = arrived.parts.iter().map(Vec::capacity).sum();
            prop_assert!(kept <= length + length.min(MAX_SPARE_BYTES), "{} of {}", kept, length);
        }
        prop_assert_eq!(arrived.join(), frames.concat());
    }

    #[test]
    fn messages_are_whole_at_their_ends_only(
        lengths in prop::collection::vec(0..40_usize, 1..8),
        pieces in prop::collection::vec(1..12_usize, 1..100),
    ) {
        let (mut sent, mut ends) = (BytesMut::new(), vec![0]);
        for length in lengths {
            sent.put_u8(0);
            sent.put_u32(length as u32);
            sent.put_bytes(255, length);
            ends.push(sent.len());
        }
        let (mut messages, mut at) = (Messages::default(), 0);
        for piece in pieces.into_iter().cycle() {
            let begun = ends.iter().rposition(|end| *end <= at).unwrap();
            prop_assert_eq!(messages.ended, begun as u64);
            prop_assert_eq!(messages.unfinished, at - ends[begun]);
            prop_assert_eq!(messages.are_whole(), ends.contains(&at));
            if at == sent.len() {
                break;
            }
            let end = sent.len().min(at + piece);
            messages.advance(&sent[at..end]);
            at = end;
        }
    }
}
