//! The operations that an index remembers, so that a retry has no second effect.

use std::{collections::HashMap, sync::Arc};

use crate::log::{BoundedQueue, Operation};

/// The bounds on the operations that an index remembers. The newest operation is always remembered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OperationWindow {
    /// The maximum number of operations.
    pub count: usize,
    /// The maximum bytes of operations (see [`Operation::bytes`]).
    pub bytes: usize,
}

impl Default for OperationWindow {
    fn default() -> Self {
        Self {
            count: 10_000,
            bytes: 16 * 1024 * 1024,
        }
    }
}

/// The newest operations, by id.
pub(super) struct Operations {
    window: OperationWindow,
    by_id: HashMap<String, Arc<Operation>>,
    newest: BoundedQueue<Arc<Operation>>,
}

impl Operations {
    /// These operations, oldest first, within these bounds.
    pub(super) fn of(window: OperationWindow, operations: Vec<Arc<Operation>>) -> Self {
        let mut all = Self {
            window,
            by_id: HashMap::new(),
            newest: BoundedQueue::default(),
        };
        for operation in operations {
            all.remember(operation);
        }
        all
    }

    /// The bounds.
    pub(super) fn window(&self) -> OperationWindow {
        self.window
    }

    /// The bytes of all operations (see [`Operation::bytes`]).
    pub(super) fn bytes(&self) -> u64 {
        self.newest.window().bytes
    }

    pub(super) fn recall(&self, id: &str) -> Option<&Arc<Operation>> {
        self.by_id.get(id)
    }

    /// Adds an operation with a new id and forgets the oldest ones outside the bounds.
    pub(super) fn remember(&mut self, operation: Arc<Operation>) {
        let bytes = operation.bytes();
        self.by_id
            .insert(operation.id.clone(), Arc::clone(&operation));
        self.newest.push(operation, bytes);
        let OperationWindow { count, bytes } = self.window;
        while let Some(forgotten) = self.newest.forget(count, bytes, |_| false) {
            // A newer operation may have its id.
            let remembered = self.recall(&forgotten.id);
            if remembered.is_some_and(|it| Arc::ptr_eq(it, &forgotten)) {
                self.by_id.remove(&forgotten.id);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The store may still hold an operation that was forgotten before its id was used again.
    #[test]
    fn a_forgotten_operation_leaves_a_newer_one_of_its_id() {
        let operation = |id: &str| {
            Arc::new(Operation {
                id: id.into(),
                fingerprint: [1; 32],
                response: Default::default(),
            })
        };
        let (first, newer) = (operation("x"), operation("x"));
        let window = OperationWindow {
            count: 2,
            ..Default::default()
        };
        let stored = vec![first, operation("y"), Arc::clone(&newer)];
        let operations = Operations::of(window, stored);
        let recalled = operations.recall("x").unwrap();
        assert!(Arc::ptr_eq(recalled, &newer));
    }
}
