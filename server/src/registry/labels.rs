//! The labels of indices in metrics: their names, up to a bound.

use std::{collections::BTreeSet, sync::Arc};

use parking_lot::Mutex;

/// The most names of indices in metrics.
const MAX_LABELS: usize = 100;

/// No index has this name.
const OTHERS: &str = "(others)";

/// See the module.
#[derive(Debug)]
pub(super) struct Labels {
    /// The names that have a label of their own, also of some indices that were deleted.
    own: Mutex<BTreeSet<Arc<str>>>,
    /// The label of all others.
    others: Arc<str>,
}

impl Default for Labels {
    fn default() -> Self {
        Self {
            own: Mutex::default(),
            others: OTHERS.into(),
        }
    }
}

impl Labels {
    /// The label of an index of this name.
    pub(super) fn of(&self, name: &str) -> Arc<str> {
        let mut own = self.own.lock();
        if let Some(known) = own.get(name) {
            return Arc::clone(known);
        }
        if own.len() >= MAX_LABELS {
            // Neither an index nor a call has these.
            own.retain(|label| Arc::strong_count(label) > 1);
        }
        if own.len() >= MAX_LABELS {
            return Arc::clone(&self.others);
        }
        let label: Arc<str> = name.into();
        own.insert(Arc::clone(&label));
        label
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_nothing_has_gives_its_label_to_a_new_one() {
        let labels = Labels::default();
        let mut held: Vec<_> = (0..MAX_LABELS)
            .map(|number| labels.of(&number.to_string()))
            .collect();
        assert_eq!(&*labels.of("new"), OTHERS);
        held.pop();
        assert_eq!(&*labels.of("new"), "new");
        assert_eq!(&*labels.of("0"), "0");
    }
}
