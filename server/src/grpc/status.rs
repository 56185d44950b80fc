//! Statuses, answers and streams of the service in tonic's types.

use std::sync::Arc;

use bytes::Bytes;
use futures_util::{StreamExt, stream, stream::BoxStream};
use prost::Message;
use tonic::{Code, Response, Status};
use wayfold_proto::v1;

use super::body::frame_bytes;
use crate::{
    admission::{Flow, HeldBytes},
    observe::Ending,
    service::{self, Error, Scan, Snapshot, Verification, Watch},
    status,
};

/// The answer of a handler.
pub(crate) type Answer<T> = Result<Response<T>, Status>;

/// The streamed answer of a handler.
pub(crate) type Messages<T> = BoxStream<'static, Result<T, Status>>;

impl From<status::Status> for Status {
    fn from(status: status::Status) -> Self {
        // The details of a gRPC status are a google.rpc.Status, and ours is the same field for field.
        let details = Bytes::from(status.to_message().encode_to_vec());
        let code = Code::from_i32(status.code.number());
        Self::with_details(code, status.message, details)
    }
}

/// The status of a failed call.
pub(crate) fn from_error(error: &Error) -> Status {
    status::from_error(error).into()
}

/// The answer of a unary call.
pub(crate) fn respond<T>(result: Result<T, Error>) -> Answer<T> {
    result
        .map(Response::new)
        .map_err(|error| from_error(&error))
}

/// The source of a streamed answer.
pub(crate) trait Source: Send + Sized + 'static {
    /// A message.
    type Message: Message + 'static;

    /// Waits until there is a message. Returns about how many bytes making it takes.
    fn next_bytes(&mut self) -> impl Future<Output = Result<usize, Error>> + Send;

    /// The next message; None after the last.
    fn next(&mut self) -> impl Future<Output = Option<Result<Self::Message, Error>>> + Send;

    /// The most bytes that it keeps between two messages, the same at all times.
    fn kept_bytes(&self) -> usize {
        0
    }

    /// Gives up what it keeps for further messages, which takes room.
    fn give_up_room(&mut self) {}
}

macro_rules! sources {
    ($($source:ident: $message:ident { $($other:tt)* })*) => {
        $(impl Source for $source {
            type Message = v1::$message;

            async fn next_bytes(&mut self) -> Result<usize, Error> {
                Ok($source::next_bytes(self))
            }

            fn next(&mut self) -> impl Future<Output = Option<Result<Self::Message, Error>>> + Send {
                $source::next(self)
            }

            $($other)*
        })*
    };
}

sources! {
    Scan: ScanResponse {}
    Snapshot: SnapshotIndexResponse {}
    Verification: VerifyIndexResponse {
        fn kept_bytes(&self) -> usize {
            Verification::kept_bytes(self)
        }
    }
}

impl Source for Watch {
    type Message = v1::WatchResponse;

    fn next_bytes(&mut self) -> impl Future<Output = Result<usize, Error>> + Send {
        Watch::next_bytes(self)
    }

    fn next(&mut self) -> impl Future<Output = Option<Result<Self::Message, Error>>> + Send {
        Watch::next(self)
    }

    fn give_up_room(&mut self) {
        self.forget_read_ahead();
    }
}

/// The answer of a streaming call. A message is made while the budget of `flow` has room: a client can ask for thousands of
/// messages at once, and read none.
pub(crate) fn respond_all<S: Source>(
    flow: Option<Arc<Flow>>,
    source: Result<S, Error>,
) -> Answer<Messages<S::Message>> {
    respond(source.map(|source| {
        let parts = Parts {
            source,
            flow,
            making: None,
        };
        stream::unfold(parts, Parts::next).boxed()
    }))
}

/// The messages of a streamed answer.
struct Parts<S> {
    source: S,
    flow: Option<Arc<Flow>>,
    /// Counts the bytes that the making of a message takes, and then those of the message until the connection asks for the next.
    /// Those that the source keeps count until its end.
    making: Option<HeldBytes>,
}

impl<S: Source> Parts<S> {
    async fn next(mut self) -> Option<(Result<S::Message, Status>, Self)> {
        let message = self.make().await?;
        Some((message, self))
    }

    async fn make(&mut self) -> Option<Result<S::Message, Status>> {
        let kept = self.source.kept_bytes();
        self.making = self.making.take().filter(|_| kept > 0);
        if let Some(making) = &self.making {
            making.release_down_to(kept);
        }
        let bytes = match self.source.next_bytes().await {
            Ok(bytes) => bytes,
            Err(error) => return Some(Err(from_error(&error))),
        };
        // A connection may ask for a message and never take it. Once it takes the message, that counts as unread.
        let flow = self.flow.as_ref().filter(|_| bytes > 0);
        let (making, more) = match self.making.take() {
            Some(making) => (Some(making), bytes),
            None => (flow.map(|flow| flow.hold()), bytes + kept),
        };
        self.making = making.filter(|_| bytes > 0);
        if let Some(making) = &self.making {
            if !making.has_room(more) {
                self.source.give_up_room();
            }
            if !making.wait_for(more).await {
                let refused = status::too_many_bytes(making.flow().max_bytes());
                return Some(Err(refused.into()));
            }
        }
        let message = self.source.next().await?;
        if let (Some(making), Ok(message)) = (&self.making, &message) {
            making.release(bytes.saturating_sub(frame_bytes(message.encoded_len())));
        }
        Some(message.map_err(|error| from_error(&error)))
    }
}

/// The ending of a call with this code.
pub(crate) fn ending(code: Code) -> Ending {
    match code {
        Code::Ok => Ending::Ok,
        Code::Cancelled => Ending::Left,
        other => {
            let number = other.into();
            service::Code::of_number(number).map_or(Ending::Transport(number), Ending::Failed)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        admission::Admission,
        config::Config,
        service::{Call, Violation},
        testing::{recorded, server},
    };

    #[tokio::test]
    async fn a_verification_that_nobody_reads_counts_what_it_keeps() {
        let log = recorded(1);
        let service = server(&log, &log);
        let request = v1::VerifyIndexRequest {
            index_name: "arm".into(),
            query_count: Some(1000),
            k: Some(100),
            ..Default::default()
        };
        let verification = service.verify_index(&Call::default(), request).await;
        let kept = Source::kept_bytes(verification.as_ref().unwrap());
        assert!(kept > 1000 * 100 * 16, "{kept}");
        let flow = Admission::new(&Config::default().admission, 1, 0).open();
        let answer = respond_all(Some(Arc::clone(&flow)), verification).unwrap();
        let mut messages = answer.into_inner();
        assert_eq!(flow.held(), 0);
        while let Some(message) = messages.next().await {
            message.unwrap();
            let held = flow.held();
            assert!((kept..kept + 4096).contains(&held), "{held}");
        }
        assert_eq!(flow.held(), 0);
    }

    /// It would wait for itself otherwise.
    #[tokio::test]
    async fn a_call_does_not_wait_for_the_bytes_that_it_holds() {
        let flow = Admission::new(&Config::default().admission, 1, 0).open();
        let held = flow.hold();
        held.force_take(flow.max_bytes());
        assert!(!held.further().has_room(1));
        assert!(held.wait_for(1).await);
    }

    #[test]
    fn a_status_fits_into_headers_whatever_the_caller_wrote() {
        let long = "ü".repeat(100_000);
        let violation = Violation {
            field: long.clone(),
            reason: "NAN",
            description: long.clone(),
        };
        for error in [
            Error::IndexNotFound { name: long.clone() },
            Error::InvalidArgument {
                violations: vec![violation; 100],
            },
            Error::RevisionConflict {
                index: long.clone(),
                if_revision: u64::MAX,
                ids: vec![u64::MAX; 100_000],
            },
            Error::IndexExists {
                name: long.clone(),
                what: "space",
                existing: long.clone(),
                requested: long.clone(),
            },
        ] {
            let mut headers = http::HeaderMap::new();
            Status::from(crate::status::from_error(&error))
                .add_header(&mut headers)
                .unwrap();
            let bytes: usize = headers
                .iter()
                .map(|(name, value)| name.as_str().len() + value.len() + 32)
                .sum();
            assert!(bytes < 8 * 1024, "{bytes} bytes");
        }
    }
}
