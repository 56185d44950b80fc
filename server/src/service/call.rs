//! The context of a call, and time slices by which a long call shares its thread.

use std::{
    fmt,
    future::Future,
    net::SocketAddr,
    sync::{Arc, OnceLock},
    time::{Duration, Instant},
};

use super::Error;
use crate::{
    admission::{AnswerBytes, CallPlace, ClientPermits, HeldBytes, PlaceWait, end_slice},
    identity::{Caller, Denial},
    log::Uid,
};

/// The time that a call computes before it yields.
const MAX_STEP_TIME: Duration = Duration::from_micros(500);

/// The other end of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Peer {
    /// The address of a connection.
    Address(SocketAddr),
    /// The id of a Zenoh session. Only a query that names its source has it.
    Session(u128),
}

impl fmt::Display for Peer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Address(address) => address.fmt(f),
            Self::Session(id) => write!(f, "{id:x}"),
        }
    }
}

/// The context of one call.
#[derive(Clone, Debug, Default)]
pub struct Call {
    /// When the caller stops waiting; None: never. Long batches check it too.
    pub deadline: Option<Instant>,
    /// True if the caller named no deadline and has the server's.
    pub has_default_deadline: bool,
    /// The caller.
    pub caller: Caller,
    /// The other end of the call, if the face knows it.
    pub peer: Option<Peer>,
    /// Its place in a trace, after W3C Trace Context.
    pub trace: Option<Arc<str>>,
    /// True if another server of the cluster forwarded it. It is not forwarded again.
    pub is_forwarded: bool,
    /// The number of its client at the server that forwarded it. None if none did, or if that one does not send it.
    pub forwarded_client: Option<u64>,
    /// The uid of its index at the server that forwarded it. None if none did, or if that one does not send it.
    pub forwarded_uid: Option<Uid>,
    /// The permits of its connection; None: those of the server alone bound it.
    pub permits: Option<Arc<ClientPermits>>,
    /// The bytes of the call, if its answer counts while it is made; None: nothing bounds that, or a stream counts each part.
    pub held: Option<Arc<HeldBytes>>,
    /// Its place, which another call may get while this one waits for a revision. None: the call keeps its place.
    pub place: Option<Arc<CallPlace>>,
    /// Gets the label of the index of the call, for its metrics, once the index is found.
    pub index: Arc<OnceLock<Arc<str>>>,
}

impl Call {
    /// Waits for `future` until the deadline.
    pub(super) async fn bound<F: Future>(
        &self,
        doing: &'static str,
        future: F,
    ) -> Result<F::Output, Error> {
        let Some(deadline) = self.deadline else {
            return Ok(future.await);
        };
        tokio::time::timeout_at(deadline.into(), future)
            .await
            .map_err(|_| Error::DeadlineExceeded { doing })
    }

    /// Fails if the deadline has passed, or if the caller lost its rights since the call began.
    pub(super) fn check(&self, doing: &'static str) -> Result<(), Error> {
        self.caller.check().map_err(|why| Error::Denied {
            why: Denial::Unknown(why),
        })?;
        match self.deadline {
            Some(deadline) if Instant::now() >= deadline => Err(Error::DeadlineExceeded { doing }),
            _ => Ok(()),
        }
    }

    /// Notes that the call only waits: another call may get its place until the result is dropped.
    pub(super) fn wait_in_place(&self) -> Option<PlaceWait> {
        self.place.as_ref().map(CallPlace::wait)
    }

    /// Begins to count the bytes of an answer.
    pub(crate) fn answer_bytes(&self) -> AnswerBytes {
        AnswerBytes::of(self.held.clone())
    }

    /// Begins work that may be long.
    pub(crate) fn pace(&self, doing: &'static str) -> TimeSlicer {
        TimeSlicer {
            call: self.clone(),
            doing,
            began: Instant::now(),
        }
    }
}

/// Slices long work: between two slices other tasks run and the deadline is checked.
pub(crate) struct TimeSlicer {
    call: Call,
    doing: &'static str,
    began: Instant,
}

impl TimeSlicer {
    /// Fails if the deadline has passed.
    pub(super) fn check(&self) -> Result<(), Error> {
        self.call.check(self.doing)
    }

    /// Ends a step of work; a step takes between a microsecond and [`MAX_STEP_TIME`].
    pub(crate) async fn step(&mut self) -> Result<(), Error> {
        if self.began.elapsed() < MAX_STEP_TIME {
            return Ok(());
        }
        self.check()?;
        end_slice().await;
        self.began = Instant::now();
        Ok(())
    }
}
