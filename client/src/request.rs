//! One request a file: what can be set, how it is divided and sent, and what comes back.

mod get;
mod insert;
mod knn;
mod query;
mod remove;
mod restore;
mod scaling;
mod scan;
mod snapshot;
mod stream_knn;
mod update;
mod verify;
mod watch;

pub use get::Get;
pub use insert::{Insert, Inserted, NeighborQuery, Outcome};
pub use knn::Knn;
pub use query::Query;
pub use remove::{Remove, Removed};
pub use scan::{Scan, ScanRequest};
pub use snapshot::{Snapshot, SnapshotRequest};
pub(crate) use stream_knn::open_stream;
pub use stream_knn::{KnnAnswers, KnnRequests};
pub use update::{Update, Updated};
pub use verify::{Verified, Verify};
pub use watch::{Mutation, Reset, ResetReason, Watch, WatchEvent, WatchRequest};

use std::ops::Range;

use wayfold_index::Filter;

use crate::{Error, Include};

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

/// How exact a search is to be, among which points, and what it tells of them: what [`Knn`] and [`Query`] both set.
#[derive(Clone, Copy, Debug, Default)]
struct SearchOptions {
    epsilon: f64,
    max_leaves: u32,
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

            /// Visits at most so many leaves of the trees for each state; as many as exactness needs unless set.
            pub fn max_leaves(mut self, leaves: u32) -> $request {
                self.options.max_leaves = leaves;
                self
            }

            /// Only some of the points.
            pub fn filter(mut self, filter: Filter) -> $request {
                self.options.filter = filter;
                self
            }

            /// What to tell of each neighbour beside its id and distance.
            pub fn include(mut self, include: Include) -> $request {
                self.options.include = include;
                self
            }
        }
    };
}
use search_options;

/// Says of the failure of a later part of a mutation how many rows had taken effect.
fn partial(part: &Range<usize>, rows: usize, error: Error) -> Error {
    match part.start {
        0 => error,
        done => Error::Partial {
            done,
            rows,
            source: Box::new(error),
        },
    }
}

/// The id of a mutation that its caller gave none, so that it can be tried again.
fn fresh_operation_id() -> String {
    uuid::Uuid::new_v4().to_string()
}
