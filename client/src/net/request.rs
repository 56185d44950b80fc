//! The requests, one a file: settings, division among calls, and answer.

mod get;
mod insert;
mod knn;
mod query;
mod remove;
mod restore;
mod scan;
mod snapshot;
mod stream_knn;
mod update;
mod verify;
mod watch;

pub use get::Get;
pub use insert::{Insert, Inserted, Outcome};
pub use knn::Knn;
pub use query::Query;
pub use remove::{Remove, Removed};
pub use scan::{Scan, ScanRequest};
pub use snapshot::{Snapshot, SnapshotRequest};
pub(crate) use stream_knn::open_stream;
pub use stream_knn::{KnnAnswers, KnnRequests};
pub use update::{Update, Updated};
pub use verify::{Verified, Verify};
#[cfg(feature = "zenoh")]
pub(crate) use watch::WatchStart;
pub use watch::{Mutation, Reset, ResetReason, Watch, WatchEvent, WatchRequest};

use std::time::Duration;

use bytes::Bytes;
use tokio::time;
use tonic::Streaming;

use crate::{Error, Filter, Include, IndexHandle};

/// The longest timeout of a call, some decades: the time at which a longer one ends may have no number.
pub(crate) const MAX_WAIT: Duration = Duration::from_secs(1 << 30);

/// The bytes of an id and a tag in a request.
const ID_AND_TAG_BYTES: usize = 16;

/// The bytes of the payload of a row in a request, with its head; 0 for a row without one.
fn payload_bytes(payloads: &[Bytes], row: usize) -> usize {
    const HEAD_BYTES: usize = 4;
    let payload = payloads.get(row);
    payload.map_or(0, |payload| payload.len() + HEAD_BYTES)
}

/// Makes a request awaitable: `index.knn(states).k(10).await`.
macro_rules! awaitable {
    ($request:ty => $answer:ty) => {
        impl IntoFuture for $request {
            type Output = Result<$answer, $crate::Error>;
            type IntoFuture = futures_util::future::BoxFuture<'static, Self::Output>;

            fn into_future(self) -> Self::IntoFuture {
                Box::pin(self.send())
            }
        }
    };
}
use awaitable;

/// Gives a stream of `item`s, which has a method `next`, its form as a [`Stream`](futures_util::Stream). All streams of
/// the client have both. It ends after the first error.
macro_rules! into_stream {
    ($stream:ty => $item:ty) => {
        impl $stream {
            /// The rest as a [`Stream`](futures_util::Stream).
            pub fn into_stream(
                self,
            ) -> impl futures_util::Stream<Item = Result<$item, $crate::Error>> + Send + 'static
            {
                futures_util::stream::try_unfold(self, |mut stream| async move {
                    Ok(stream.next().await?.map(|item| (item, stream)))
                })
            }
        }
    };
}
use into_stream;

/// The next message of a stream, within the handle's timeout.
async fn receive<M>(
    call: &'static str,
    index: &IndexHandle,
    messages: &mut Streaming<M>,
) -> Result<Option<M>, Error> {
    let timeout = index.timeout();
    let message = time::timeout(timeout, messages.message()).await;
    let message = message.map_err(|_| Error::timeout(call, timeout))?;
    message.map_err(|status| Error::from_status(call, index.client().uri(), timeout, status))
}

/// The options that [`Knn`] and [`Query`] share.
#[derive(Clone, Debug, Default)]
struct SearchOptions {
    epsilon: f64,
    filter: Filter,
    include: Include,
}

/// Gives a request the setters of its field `options`, a [`SearchOptions`].
macro_rules! search_options {
    ($request:ident, $epsilon:literal) => {
        impl $request {
            #[doc = $epsilon]
            pub fn epsilon(mut self, epsilon: f64) -> $request {
                self.options.epsilon = epsilon;
                self
            }

            /// Only some of the points.
            pub fn filter(mut self, filter: Filter) -> $request {
                self.options.filter = filter;
                self
            }

            /// The columns of the answer in addition to ids and distances; none unless set.
            pub fn include(mut self, include: Include) -> $request {
                self.options.include = include;
                self
            }
        }
    };
}
use search_options;

/// The operation id of a mutation whose caller gave none, so that the client can retry it.
pub(crate) fn fresh_operation_id() -> String {
    uuid::Uuid::new_v4().to_string()
}

/// Gives a mutation the setter of its field `operation_id`, and its index.
macro_rules! mutation {
    ($request:ident) => {
        impl $request {
            /// Names the operation, in at most 64 bytes: it takes effect once, however often it is sent under this id.
            /// Unless set, the client makes one for its own retries. The later parts of a divided call have `ID/ROW`,
            /// with their first row. An empty id counts as none.
            pub fn operation_id(mut self, id: impl Into<String>) -> $request {
                let id = id.into();
                if !id.is_empty() {
                    self.operation_id = id;
                }
                self
            }
        }
    };
}
use mutation;

/// Refuses a column whose number of `values` is not allowed for `rows` states or ids, the last of the allowed numbers.
fn check_column(
    field: &'static str,
    values: usize,
    allowed: &[usize],
    rows: &str,
) -> Result<(), Error> {
    if allowed.contains(&values) {
        return Ok(());
    }
    let count = allowed.last().copied().unwrap_or_default();
    Err(Error::Argument {
        field,
        problem: format!("{values} given for {count} {rows}"),
    })
}
