//! The mutations that a replica can wait for.

use crate::{Error, IndexHandle, Insert, Inserted, Remove, Removed, Update, Updated};

/// A mutation, not yet sent: [`Insert`], [`Update`] or [`Remove`].
pub trait Write: IntoFuture<Output = Result<Self::Answer, Error>> + sealed::Sealed {
    /// What it is answered.
    type Answer;

    /// Which index it is for.
    fn handle(&self) -> &IndexHandle;

    /// The revision from which on reads see it.
    fn revision(answer: &Self::Answer) -> u64;
}

mod sealed {
    pub trait Sealed {}
}

macro_rules! write {
    ($request:ty => $answer:ty) => {
        impl sealed::Sealed for $request {}

        impl Write for $request {
            type Answer = $answer;

            fn handle(&self) -> &IndexHandle {
                self.index()
            }

            fn revision(answer: &$answer) -> u64 {
                answer.revision
            }
        }
    };
}

write!(Insert => Inserted);
write!(Update => Updated);
write!(Remove => Removed);
