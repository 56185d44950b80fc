//! One request a file: what can be set, how it is divided and sent, and what comes back.

mod get;
mod insert;
mod knn;
mod query;
mod remove;
mod scan;
mod stream_knn;
mod update;

pub use get::Get;
pub use insert::{Insert, Inserted, NeighborQuery, Outcome};
pub use knn::Knn;
pub use query::Query;
pub use remove::{Remove, Removed};
pub use scan::{Scan, ScanRequest};
pub(crate) use stream_knn::open_stream;
pub use stream_knn::{KnnAnswers, KnnRequests};
pub use update::{Update, Updated};

use std::ops::Range;

use crate::Error;

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
