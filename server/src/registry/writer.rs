//! The one writer of an index: its forest at the head, and what evaluation needs to know of the past.

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::sync::OwnedMutexGuard;
use wayfold_index::Forest;

use super::{OperationWindow, Published, operations::Operations};
use crate::log::{Operation, Record, View};

/// Exclusive hold of an index's writer.
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

/// The state that records are applied to. Its head may be ahead of what readers see, where the log is not yet synced.
pub struct Writer {
    pub(super) forest: Forest,
    /// How many tasks merge this forest's levels.
    pub(super) mergers: usize,
    head: Arc<Published>,
    operations: Operations,
    /// The newest revision that did anything else than add points, or may have.
    last_change: u64,
    /// What was asked to be remembered last.
    window: OperationWindow,
    /// By all guards that are gone.
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

    /// The state that the next mutation is evaluated against.
    pub fn head(&self) -> &Arc<Published> {
        &self.head
    }

    /// For how long it was held in all: what mutations of one index cannot do side by side.
    pub fn held(&self) -> Duration {
        self.held
    }

    /// The operation of this id, if it took effect and is remembered.
    pub fn recall(&self, id: &str) -> Option<&Arc<Operation>> {
        self.operations.recall(id)
    }

    /// Whether every point of that revision is what it was, and every other point newer.
    pub fn only_added_since(&self, revision: u64) -> bool {
        self.last_change <= revision
    }

    /// How many operations are remembered.
    pub(super) fn window(&self) -> OperationWindow {
        self.window
    }

    /// Whether the forest is at `revision`, and so is the head.
    pub(super) fn is_at(&self, revision: u64) -> bool {
        self.head.revision == revision && self.forest.revision() == revision
    }

    /// Remembers an operation.
    pub fn remember(&mut self, operation: Arc<Operation>, window: OperationWindow) {
        self.operations.remember(operation, window);
    }

    /// Applies a record: the only way in which the forest's points change.
    pub(super) fn apply(&mut self, record: &Record, window: OperationWindow) {
        let effects = record.effects();
        self.window = window;
        if !effects.only_adds() {
            self.last_change = record.revision();
        }
        self.forest
            .apply(record.revision(), effects.stored(), effects.removed());
        if let Some(operation) = effects.operation() {
            self.remember(Arc::clone(operation), window);
        }
    }

    /// Takes the forest and `view`, its points as the log has them, for the new head.
    pub(super) fn advance(&mut self, view: Arc<dyn View>) {
        self.head = Arc::new(Published {
            snapshot: self.forest.snapshot(),
            revision: view.revision(),
            view,
        });
    }

    /// Takes the forest as it is now for the head, at the same revision.
    pub(super) fn refresh(&mut self) {
        self.advance(Arc::clone(&self.head.view));
    }
}
