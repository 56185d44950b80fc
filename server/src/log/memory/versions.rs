//! Multi-version points: each reader sees the versions of its own revision while the writer adds new ones.

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Bound,
    sync::Arc,
};

use crate::log::StoredPoint;

/// All versions of points that can still be read.
///
/// A revision is visible if a view is pinned to it, or if it is the head, to which the next view will be pinned.
/// Invariants:
/// - A revision sees the newest version of an id that is not newer than the revision. So a version is seen from the
///   revision that made it up to the one before the revision that superseded it.
/// - A superseded version is in `superseded` under the newest revision that sees it. Once that revision is released, the
///   version is in `released` until [`Versions::collect`] finds another revision that sees it, or drops it. So the
///   versions kept in addition to the head's points are at most those that pinned revisions see, and those in
///   `released`.
/// - The mark of a removed point directly follows a version that it hides.
pub(super) struct Versions {
    /// The versions by id and the revision that made them. None is the mark of a removed point.
    versions: BTreeMap<(u64, u64), Option<Arc<StoredPoint>>>,
    /// The number of pins of each revision.
    pinned: BTreeMap<u64, usize>,
    /// The revision that the next view is pinned to; it is pinned itself.
    head: u64,
    superseded: BTreeMap<u64, Vec<SupersededVersion>>,
    released: VecDeque<Vec<SupersededVersion>>,
}

struct SupersededVersion {
    version: (u64, u64),
    by: u64,
}

impl Default for Versions {
    fn default() -> Self {
        Self {
            versions: BTreeMap::new(),
            pinned: BTreeMap::from([(0, 1)]),
            head: 0,
            superseded: BTreeMap::new(),
            released: VecDeque::new(),
        }
    }
}

impl Versions {
    /// Adds the first version of a point whose id was never used before.
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
        if self.supersede(id, revision) {
            self.versions.insert((id, revision), None);
        }
    }

    /// Supersedes the newest version of a point; false if there is none.
    fn supersede(&mut self, id: u64, by: u64) -> bool {
        let newest = self.versions.range((id, 0)..(id, by)).next_back();
        let Some((&version, Some(_))) = newest else {
            return false;
        };
        // The head has not advanced to `by` yet, so it still sees the version.
        let superseded = self.superseded.entry(self.head).or_default();
        superseded.push(SupersededVersion { version, by });
        true
    }

    /// Lets new views see the versions up to `revision`.
    pub(super) fn advance(&mut self, revision: u64) {
        self.pin(revision);
        let before = std::mem::replace(&mut self.head, revision);
        self.unpin(before);
    }

    pub(super) fn pin(&mut self, revision: u64) {
        *self.pinned.entry(revision).or_default() += 1;
    }

    /// Takes constant time, however many versions the revision was the last to see.
    pub(super) fn unpin(&mut self, revision: u64) {
        if let Some(count) = self.pinned.get_mut(&revision) {
            *count -= 1;
            if *count == 0 {
                self.pinned.remove(&revision);
                self.released.extend(self.superseded.remove(&revision));
            }
        }
    }

    /// Examines up to `limit` released versions and drops those that no revision sees; false if none is left.
    pub(super) fn collect(&mut self, limit: usize) -> bool {
        for _ in 0..limit {
            let Some(oldest) = self.released.front_mut() else {
                return false;
            };
            match oldest.pop() {
                Some(superseded) => self.keep_or_drop(superseded),
                None => {
                    self.released.pop_front();
                }
            }
        }
        !self.released.is_empty()
    }

    fn keep_or_drop(&mut self, superseded: SupersededVersion) {
        let (_, made) = superseded.version;
        match self.pinned.range(made..superseded.by).next_back() {
            Some((&revision, _)) => self
                .superseded
                .entry(revision)
                .or_default()
                .push(superseded),
            None => self.forget(superseded.version),
        }
    }

    /// Drops a version, and the mark after it if the mark then hides nothing.
    fn forget(&mut self, version: (u64, u64)) {
        let (id, made) = version;
        self.versions.remove(&version);
        let before = self.versions.range((id, 0)..version).next_back();
        if let Some((_, Some(_))) = before {
            return;
        }
        let after = self.versions.range(version..=(id, u64::MAX)).next();
        if let Some((&mark, None)) = after {
            debug_assert!(mark.1 > made, "a mark comes after what it hides");
            self.versions.remove(&mark);
        }
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
    use std::collections::BTreeSet;

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
        Collect,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            4 => (0..6u64).prop_map(Step::Store),
            2 => (0..6u64).prop_map(Step::Remove),
            2 => Just(Step::Pin),
            2 => any::<prop::sample::Index>().prop_map(|at| Step::Unpin(at.index(1000))),
            1 => Just(Step::Collect),
        ]
    }

    proptest! {
        #![proptest_config(crate::testing::cases(256))]

        /// Compared with full copies: every view sees its own revision, however long it is held and however many
        /// versions wait to be dropped. Once none waits, only visible versions are left.
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
                    Step::Collect => {
                        while versions.collect(1) {}
                        let copies = views.iter().map(|(_, seen)| seen).chain([&model]);
                        let seen: BTreeSet<_> = copies
                            .flat_map(|copy| copy.values().map(|point| (point.id, point.modified)))
                            .collect();
                        let kept = versions.versions.iter().filter(|(_, point)| point.is_some());
                        prop_assert!(kept.map(|(version, _)| version).eq(&seen));
                        prop_assert!(versions.len() <= 2 * seen.len());
                    }
                }
                versions.collect(1);
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
