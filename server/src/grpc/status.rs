//! Statuses, answers and streams of the service in tonic's types.

use bytes::Bytes;
use futures_util::{StreamExt, stream, stream::BoxStream};
use prost::Message;
use tonic::{Code, Response, Status};
use wayfold_proto::v1;

use crate::{
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
    type Message: Send + 'static;

    /// The next message; None after the last.
    fn next(&mut self) -> impl Future<Output = Option<Result<Self::Message, Error>>> + Send;
}

macro_rules! sources {
    ($($source:ident: $message:ident;)*) => {
        $(impl Source for $source {
            type Message = v1::$message;

            fn next(&mut self) -> impl Future<Output = Option<Result<Self::Message, Error>>> + Send {
                $source::next(self)
            }
        })*
    };
}

sources! {
    Scan: ScanResponse;
    Watch: WatchResponse;
    Snapshot: SnapshotIndexResponse;
    Verification: VerifyIndexResponse;
}

/// The answer of a streaming call. A message is made only when the client has room for it.
pub(crate) fn respond_all<S: Source>(source: Result<S, Error>) -> Answer<Messages<S::Message>> {
    respond(source.map(|source| {
        let messages = stream::unfold(source, async |mut source| {
            let message = source.next().await?;
            Some((message.map_err(|error| from_error(&error)), source))
        });
        messages.boxed()
    }))
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
    use crate::service::Violation;

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
