//! Points in several versions at once: each reader sees those of its own revision while the writer adds new ones.

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Bound,
    sync::Arc,
};

use crate::log::StoredPoint;

/// All versions of all points that a view may still ask for.
///
/// Invariants: of the versions of an id a view sees the newest that is not newer than itself. A version goes once
/// neither a view nor the head is older than the version in its place, and so does the mark of a removed point.
#[derive(Default)]
pub(super) struct Versions {
    /// By id and the revision that made the version; None marks that the point was removed.
    versions: BTreeMap<(u64, u64), Option<Arc<StoredPoint>>>,
    /// What may go, by the revision that put something else in its place.
    superseded: VecDeque<Superseded>,
    /// How many views are pinned to a revision.
    pinned: BTreeMap<u64, usize>,
    /// The revision that the next view is pinned to.
    head: u64,
}

struct Superseded {
    by: u64,
    version: (u64, u64),
}

impl Versions {
    /// Adds a version of a point whose id was never used before.
    pub(super) fn insert_new(&mut self, point: Arc<StoredPoint>) {
        self.versions
            .insert((point.id, point.modified), Some(point));
    }

    /// Adds a version of a point.
    pub(super) fn insert(&mut self, point: Arc<StoredPoint>) {
        self.supersede(point.id, point.modified);
        self.insert_new(point);
    }

    /// Removes a point as of `revision`.
    pub(super) fn remove(&mut self, id: u64, revision: u64) {
        self.supersede(id, revision);
        self.versions.insert((id, revision), None);
        // The mark itself has nothing to hide once the version before it is gone.
        self.superseded.push_back(Superseded {
            by: revision,
            version: (id, revision),
        });
    }

    fn supersede(&mut self, id: u64, revision: u64) {
        let newest = self.versions.range((id, 0)..(id, revision)).next_back();
        if let Some((&version, Some(_))) = newest {
            self.superseded.push_back(Superseded {
                by: revision,
                version,
            });
        }
    }

    /// Lets new views see the versions up to `revision`.
    pub(super) fn advance(&mut self, revision: u64) {
        self.head = revision;
    }

    pub(super) fn pin(&mut self, revision: u64) {
        *self.pinned.entry(revision).or_default() += 1;
    }

    pub(super) fn unpin(&mut self, revision: u64) {
        if let Some(count) = self.pinned.get_mut(&revision) {
            *count -= 1;
            if *count == 0 {
                self.pinned.remove(&revision);
            }
        }
    }

    /// Drops up to `limit` versions that nobody can see any more; false if none are left.
    pub(super) fn collect(&mut self, limit: usize) -> bool {
        let oldest = self
            .pinned
            .keys()
            .next()
            .map_or(self.head, |&view| view.min(self.head));
        for _ in 0..limit {
            match self.superseded.front() {
                Some(superseded) if superseded.by <= oldest => {
                    self.versions.remove(&superseded.version);
                    self.superseded.pop_front();
                }
                _ => return false,
            }
        }
        true
    }

    pub(super) fn get(&self, id: u64, revision: u64) -> Option<&Arc<StoredPoint>> {
        let (_, newest) = self.versions.range((id, 0)..=(id, revision)).next_back()?;
        newest.as_ref()
    }

    pub(super) fn page(
        &self,
        after: Option<u64>,
        limit: usize,
        revision: u64,
    ) -> Vec<Arc<StoredPoint>> {
        let start = match after {
            Some(id) => Bound::Excluded((id, u64::MAX)),
            None => Bound::Unbounded,
        };
        let mut page = Vec::new();
        let mut versions = self.versions.range((start, Bound::Unbounded)).peekable();
        while page.len() < limit
            && let Some((&(id, made), point)) = versions.next()
        {
            let newer = versions
                .peek()
                .is_some_and(|((next, made), _)| *next == id && *made <= revision);
            if made <= revision
                && !newer
                && let Some(point) = point
            {
                page.push(Arc::clone(point));
            }
        }
        page
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.versions.len()
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use proptest::prelude::*;

    use super::*;

    fn version(id: u64, revision: u64) -> Arc<StoredPoint> {
        Arc::new(StoredPoint {
            id,
            revision,
            modified: revision,
            tag: 0,
            state: Box::new([0.0]),
            payload: Bytes::new(),
        })
    }

    #[derive(Clone, Debug)]
    enum Step {
        Store(u64),
        Remove(u64),
        Pin,
        Unpin(usize),
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            4 => (0..6u64).prop_map(Step::Store),
            2 => (0..6u64).prop_map(Step::Remove),
            2 => Just(Step::Pin),
            2 => any::<prop::sample::Index>().prop_map(|at| Step::Unpin(at.index(1000))),
        ]
    }

    proptest! {
        /// Against whole copies: every view sees its own revision however long it is held, and once no view is held
        /// nothing but the points alive is left.
        #[test]
        fn views_see_their_revision_and_the_rest_is_freed(
            steps in prop::collection::vec(step(), 1..80)
        ) {
            let mut versions = Versions::default();
            let mut model: BTreeMap<u64, Arc<StoredPoint>> = BTreeMap::new();
            let mut views: Vec<(u64, BTreeMap<u64, Arc<StoredPoint>>)> = Vec::new();
            let mut revision = 0;
            for step in steps {
                match step {
                    Step::Store(id) => {
                        revision += 1;
                        let point = version(id, revision);
                        versions.insert(Arc::clone(&point));
                        model.insert(id, point);
                        versions.advance(revision);
                    }
                    Step::Remove(id) => {
                        if model.remove(&id).is_some() {
                            revision += 1;
                            versions.remove(id, revision);
                            versions.advance(revision);
                        }
                    }
                    Step::Pin => {
                        versions.pin(revision);
                        views.push((revision, model.clone()));
                    }
                    Step::Unpin(at) if !views.is_empty() => {
                        let (revision, _) = views.swap_remove(at % views.len());
                        versions.unpin(revision);
                    }
                    Step::Unpin(_) => {}
                }
                while versions.collect(1) {}
                for (revision, seen) in &views {
                    for id in 0..6 {
                        prop_assert_eq!(versions.get(id, *revision), seen.get(&id));
                    }
                    let paged = versions.page(None, 2, *revision);
                    let next = paged.last().map(|point| point.id);
                    let mut all = paged.clone();
                    all.extend(next.into_iter().flat_map(|id| versions.page(Some(id), 9, *revision)));
                    let expected: Vec<_> = seen.values().cloned().collect();
                    prop_assert_eq!(all, expected);
                }
            }
            for (revision, _) in views {
                versions.unpin(revision);
            }
            while versions.collect(1) {}
            prop_assert_eq!(versions.len(), model.len());
        }
    }
}
