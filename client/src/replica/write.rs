//! The mutations that a replica can wait for.

use crate::{Error, IndexHandle, Insert, Inserted, Remove, Removed, Revision, Update, Updated};

/// A mutation, not yet sent: [`Insert`], [`Update`] or [`Remove`].
pub trait Write: IntoFuture<Output = Result<Self::Answer, Error>> + sealed::Sealed {
    /// Its answer.
    type Answer;

    /// The index that it writes to.
    fn handle(&self) -> &IndexHandle;

    /// The first revision at which reads see it.
    fn revision(answer: &Self::Answer) -> &Revision;
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

            fn revision(answer: &$answer) -> &Revision {
                &answer.revision
            }
        }
    };
}

write!(Insert => Inserted);
write!(Update => Updated);
write!(Remove => Removed);
