//! Reads the messages of a stream of requests.
//!
//! Tonic's reader keeps a buffer as large as the largest message for as long as a stream lives, and a stream may be idle
//! for hours. This reader frees the buffer with the message.

use std::mem;

use bytes::{Buf, Bytes, BytesMut};
use http_body_util::BodyExt;
use tonic::{Status, body::Body};

use super::{
    refusals::{self, MessageLimit},
    request_body::HEADER_BYTES,
};

/// See the module.
pub(super) struct MessageReader {
    body: Body,
    /// The bytes of messages that are not whole yet.
    bytes: BytesMut,
    /// True if messages before these were in the same buffer.
    is_rest: bool,
    max_message_bytes: usize,
}

impl MessageReader {
    /// Reads messages of at most `max_message_bytes` from a body.
    pub(super) fn new(body: Body, max_message_bytes: usize) -> Self {
        Self {
            body,
            bytes: BytesMut::new(),
            is_rest: false,
            max_message_bytes,
        }
    }

    /// The next message; None at the end of the body. Nothing can be read after an error.
    pub(super) async fn next(&mut self) -> Option<Result<Bytes, Status>> {
        loop {
            match self.take() {
                Ok(None) => {}
                taken => return taken.transpose(),
            }
            if mem::take(&mut self.is_rest) {
                // A rest of one byte holds the whole buffer too, which may have a megabyte.
                self.bytes = BytesMut::from(&self.bytes[..]);
            }
            match self.body.frame().await {
                Some(Ok(frame)) => {
                    if let Some(data) = frame.data_ref() {
                        self.bytes.extend_from_slice(data);
                    }
                }
                // The client has left.
                Some(Err(status)) if status.details().is_empty() => return None,
                Some(Err(status)) => return Some(Err(status)),
                None if self.bytes.is_empty() => return None,
                None => return Some(Err(malformed("the stream ended within a message"))),
            }
        }
    }

    /// The first message, if all of its bytes have arrived.
    fn take(&mut self) -> Result<Option<Bytes>, Status> {
        let Some(&[flag, ref length @ ..]) = self.bytes.first_chunk::<HEADER_BYTES>() else {
            return Ok(None);
        };
        if flag != 0 {
            return Err(malformed(
                "it is compressed, which this server does not read",
            ));
        }
        let length = u32::from_be_bytes(*length) as usize;
        if length > self.max_message_bytes {
            let limit = MessageLimit::of_setting(self.max_message_bytes);
            return Err(refusals::too_large(limit, refusals::SPLIT).into());
        }
        let end = HEADER_BYTES + length;
        if self.bytes.len() < end {
            self.bytes.reserve(end - self.bytes.len());
            return Ok(None);
        }
        let mut message = self.bytes.split_to(end).freeze();
        message.advance(HEADER_BYTES);
        self.is_rest = true;
        if self.bytes.is_empty() {
            // An empty rest still holds the whole buffer.
            self.bytes = BytesMut::new();
        }
        Ok(Some(message))
    }
}

fn malformed(problem: &str) -> Status {
    refusals::malformed(problem).into()
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use bytes::BufMut;
    use futures_util::{poll, stream};
    use http_body::Frame;
    use http_body_util::StreamBody;
    use proptest::prelude::*;
    use tokio::sync::mpsc;
    use tokio_stream::wrappers::UnboundedReceiverStream;
    use tonic::Code;

    use super::*;

    const MAX_BYTES: usize = 50;

    fn body(pieces: Vec<Bytes>) -> Body {
        let frames = pieces
            .into_iter()
            .map(|piece| Ok::<_, Status>(Frame::data(piece)));
        Body::new(StreamBody::new(stream::iter(frames)))
    }

    fn framed(messages: &[Vec<u8>]) -> Bytes {
        let mut sent = BytesMut::new();
        for message in messages {
            sent.put_u8(0);
            sent.put_u32(message.len() as u32);
            sent.put_slice(message);
        }
        sent.freeze()
    }

    async fn read(body: Body) -> (Vec<Bytes>, Option<Status>) {
        let (mut reader, mut read) = (MessageReader::new(body, MAX_BYTES), Vec::new());
        while let Some(message) = reader.next().await {
            match message {
                Ok(message) => read.push(message),
                Err(status) => return (read, Some(status)),
            }
        }
        (read, None)
    }

    proptest! {
        #![proptest_config(crate::testing::cases(200))]

        #[test]
        fn messages_come_whole_however_they_are_cut(
            messages in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..=MAX_BYTES), 0..8),
            pieces in prop::collection::vec(1..80_usize, 1..20),
            lost in 0..3_usize,
        ) {
            let sent = framed(&messages);
            let sent = sent.slice(..sent.len().saturating_sub(lost));
            let (mut rest, mut cut) = (sent.clone(), Vec::new());
            for piece in pieces.into_iter().cycle() {
                if rest.is_empty() {
                    break;
                }
                cut.push(rest.split_to(piece.min(rest.len())));
            }
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let (read, status) = runtime.block_on(read(body(cut)));
            // A header is longer than what is lost: the last message has begun.
            let is_cut = lost > 0 && !messages.is_empty();
            let whole = messages.len() - usize::from(is_cut);
            prop_assert_eq!(&read, &messages[..whole]);
            prop_assert_eq!(status.is_some(), is_cut);
        }
    }

    #[tokio::test]
    async fn a_message_above_the_limit_and_a_compressed_one_are_refused() {
        let (read_before, status) =
            read(body(vec![framed(&[vec![1], vec![0; MAX_BYTES + 1]])])).await;
        assert_eq!(read_before, [vec![1]]);
        assert_eq!(status.unwrap().code(), Code::ResourceExhausted);
        let (_, status) = read(body(vec![Bytes::from_static(&[1, 0, 0, 0, 0])])).await;
        assert_eq!(status.unwrap().code(), Code::InvalidArgument);
    }

    #[tokio::test]
    async fn a_stream_that_waits_holds_no_buffer() {
        let (send, frames) = mpsc::unbounded_channel();
        let body = Body::new(StreamBody::new(UnboundedReceiverStream::new(frames)));
        let mut reader = MessageReader::new(body, 1 << 20);
        for piece in framed(&[vec![7; 1 << 20]]).chunks(1 << 14) {
            let frame = Frame::data(Bytes::copy_from_slice(piece));
            send.send(Ok::<_, Status>(frame)).unwrap();
        }
        let message = reader.next().await.unwrap().unwrap();
        assert_eq!(message.len(), 1 << 20);
        assert_eq!(reader.bytes.capacity(), 0);
        let mut joined = framed(&vec![vec![7; 1 << 10]; 1 << 10]).to_vec();
        joined.push(0);
        send.send(Ok(Frame::data(joined.into()))).unwrap();
        for _ in 0..1 << 10 {
            reader.next().await.unwrap().unwrap();
        }
        assert!(poll!(pin!(reader.next())).is_pending());
        assert!(reader.bytes.capacity() < 1 << 10);
    }
}
