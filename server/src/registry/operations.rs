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
    /// No operations, and these bounds.
    pub(super) fn new(window: OperationWindow) -> Self {
        Self {
            window,
            by_id: HashMap::new(),
            newest: BoundedQueue::default(),
        }
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
            self.by_id.remove(&forgotten.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    fn operation(id: &str, bytes: usize) -> Arc<Operation> {
        Arc::new(Operation {
            id: id.into(),
            fingerprint: [0; 32],
            response: vec![0; bytes].into(),
        })
    }

    fn remembered(sizes: &[usize], window: OperationWindow) -> Vec<bool> {
        let mut operations = Operations::new(window);
        for (at, &bytes) in sizes.iter().enumerate() {
            operations.remember(operation(&at.to_string(), bytes));
        }
        (0..sizes.len())
            .map(|at| operations.recall(&at.to_string()).is_some())
            .collect()
    }

    #[test]
    fn the_oldest_are_forgotten_by_count_and_by_bytes() {
        let count = OperationWindow {
            count: 2,
            bytes: usize::MAX,
        };
        assert_eq!(remembered(&[0, 0, 0], count), [false, true, true]);
        let bytes = OperationWindow {
            count: usize::MAX,
            bytes: 1000,
        };
        assert_eq!(remembered(&[400, 400, 400], bytes), [false, false, true]);
        assert_eq!(remembered(&[10, 5000], bytes), [false, true]);
    }

    #[test]
    fn the_response_is_remembered_as_it_was() {
        let mut operations = Operations::new(OperationWindow { count: 1, bytes: 0 });
        let done = Arc::new(Operation {
            id: "op".into(),
            fingerprint: [7; 32],
            response: Bytes::from_static(b"response"),
        });
        operations.remember(Arc::clone(&done));
        assert_eq!(operations.recall("op"), Some(&done));
        assert_eq!(operations.recall("other"), None);
    }
}
