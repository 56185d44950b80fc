//! The single writer of an index: the forest at the head, and the operations and revisions that evaluation needs.

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::OwnedMutexGuard;
use wayfold_index::Forest;

use super::{OperationWindow, Published, operations::Operations};
use crate::log::{Operation, Record, View};

/// Exclusive access to an index's writer.
pub struct WriteGuard {
    writer: OwnedMutexGuard<Writer>,
    since: Instant,
}

impl From<OwnedMutexGuard<Writer>> for WriteGuard {
    fn from(writer: OwnedMutexGuard<Writer>) -> Self {
        let since = Instant::now();
        Self { writer, since }
    }
}

impl Deref for WriteGuard {
    type Target = Writer;

    fn deref(&self) -> &Writer {
        &self.writer
    }
}

impl DerefMut for WriteGuard {
    fn deref_mut(&mut self) -> &mut Writer {
        &mut self.writer
    }
}

impl Drop for WriteGuard {
    fn drop(&mut self) {
        self.writer.held += self.since.elapsed();
    }
}

/// The state that records are applied to. Its head is ahead of the published revision while the log is not yet synced.
pub struct Writer {
    pub(super) forest: Forest,
    /// The number of tasks that merge this forest's levels.
    pub(super) mergers: usize,
    head: Arc<Published>,
    operations: Operations,
    /// The newest revision that may have done more than add points.
    last_change: u64,
    /// The bounds that the last mutation gave.
    window: OperationWindow,
    /// The time that dropped guards held the writer, in total.
    held: Duration,
}

impl Writer {
    /// A writer whose head is `view`, with a forest of the same points.
    pub(super) fn new(forest: Forest, view: Arc<dyn View>) -> Self {
        let last_change = view.revision();
        let head = Published {
            snapshot: forest.snapshot(),
            revision: view.revision(),
            view,
        };
        Self {
            forest,
            mergers: 0,
            head: Arc::new(head),
            operations: Operations::default(),
            last_change,
            window: OperationWindow::UNBOUNDED,
            held: Duration::ZERO,
        }
    }

    /// The state against which the next mutation is evaluated.
    pub fn head(&self) -> &Arc<Published> {
        &self.head
    }

    /// The total time the writer was held: the serial part of the index's mutations.
    pub fn held(&self) -> Duration {
        self.held
    }

    /// The remembered operation with this id; None if it had no effect or is forgotten.
    pub fn recall(&self, id: &str) -> Option<&Arc<Operation>> {
        self.operations.recall(id)
    }

    /// True if every point of that revision is unchanged and every other point is newer.
    pub fn only_added_since(&self, revision: u64) -> bool {
        self.last_change <= revision
    }

    /// The bounds on remembered operations.
    pub(super) fn window(&self) -> OperationWindow {
        self.window
    }

    /// True if the forest and the head are at `revision`.
    pub(super) fn is_at(&self, revision: u64) -> bool {
        self.head.revision == revision && self.forest.revision() == revision
    }

    /// Remembers an operation.
    pub fn remember(&mut self, operation: Arc<Operation>, window: OperationWindow) {
        self.operations.remember(operation, window);
    }

    /// Applies a record. The forest's points change here only.
    pub(super) fn apply(&mut self, record: &Record, window: OperationWindow) {
        let effects = record.effects();
        self.window = window;
        if !effects.only_adds() {
            self.last_change = record.revision();
        }
        self.forest
            .apply(record.revision(), effects.stored(), effects.removed())
            .expect("a record's rows are checked before it is logged");
        if let Some(operation) = effects.operation() {
            self.remember(Arc::clone(operation), window);
        }
    }

    /// Makes the forest and `view`, the same points in the log, the new head.
    pub(super) fn advance(&mut self, view: Arc<dyn View>) {
        self.head = Arc::new(Published {
            snapshot: self.forest.snapshot(),
            revision: view.revision(),
            view,
        });
    }

    /// Makes the current forest the head, at the same revision.
    pub(super) fn refresh(&mut self) {
        self.advance(Arc::clone(&self.head.view));
    }
}
