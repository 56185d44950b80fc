//! The value of a name in the catalogue.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use tracing::warn;

use crate::log::Uid;

/// The most deleted indices of a name that are remembered.
const MAX_DELETED: usize = 1000;

/// A key's value: the index of a name, and those that had it before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct CatalogueValue {
    pub(super) name: String,
    /// The uid and [`Entry::content`]; None if the index was deleted.
    pub(super) index: Option<(String, String)>,
    /// The uids of the newest deleted indices, oldest first.
    pub(super) deleted: Vec<String>,
    /// Two servers have applied different records of this revision. The index takes no writes any more.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) contradicted: Option<u64>,
}

impl CatalogueValue {
    /// True if it names this index.
    pub(super) fn is(&self, uid: Uid) -> bool {
        let index = self.index.as_ref();
        index.is_some_and(|(own, _)| *own == uid.to_string())
    }

    /// True if another index may get the name, in the place of `replaced` if that has it.
    pub(super) fn is_free(&self, replaced: Option<Uid>) -> bool {
        self.index.is_none() || replaced.is_some_and(|it| self.is(it))
    }

    /// True if an index had the name before `hosted`, which a server has under it; false if it has it now or had it later.
    /// None if this does not tell.
    pub(super) fn is_past(&self, uid: Uid, hosted: Option<Uid>) -> Option<bool> {
        let place = |uid: Uid| {
            let uid = uid.to_string();
            self.deleted.iter().position(|it| *it == uid)
        };
        match (place(uid), hosted.and_then(place)) {
            (Some(place), hosted) => Some(hosted.is_none_or(|hosted| place < hosted)),
            // The server has yet to host the present one.
            (None, Some(_)) => Some(false),
            (None, None) => self.is(uid).then_some(false),
        }
    }

    /// True if this may have come after `before`: what was deleted stays so, and an index goes, with what is noted of it, only
    /// if it is deleted.
    pub(super) fn follows(&self, before: &Self) -> bool {
        let is_deleted = |uid: &String| self.deleted.contains(uid);
        let is_same = self.index == before.index
            && (before.contradicted.is_none() || before.contradicted == self.contradicted);
        let index = before.index.as_ref();
        let is_full = self.deleted.len() >= MAX_DELETED;
        let deleted = before.deleted.iter();
        // The oldest may be forgotten.
        let mut deleted = deleted.skip_while(|uid| is_full && !is_deleted(uid));
        deleted.all(is_deleted) && (is_same || index.is_none_or(|(uid, _)| is_deleted(uid)))
    }
}

/// The newest uids of deleted indices that are remembered.
pub(super) fn newest(mut deleted: Vec<String>) -> Vec<String> {
    let forgotten = deleted.len().saturating_sub(MAX_DELETED);
    deleted.drain(..forgotten);
    deleted
}

/// Reads a value; None if it is not one of Wayfold's.
pub(super) fn read(value: &Bytes) -> Option<CatalogueValue> {
    let named = serde_json::from_slice(value);
    named
        .inspect_err(|error| warn!(%error, "the catalogue in NATS has an entry that is not one of Wayfold's"))
        .ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(index: Option<&str>, deleted: &[&str], contradicted: Option<u64>) -> CatalogueValue {
        CatalogueValue {
            name: "arm".into(),
            index: index.map(|uid| (uid.into(), "R1".into())),
            deleted: deleted.iter().map(|uid| (*uid).into()).collect(),
            contradicted,
        }
    }

    #[test]
    fn a_uid_is_past_for_a_server_that_hosts_a_later_one() {
        let uids = [(); 4].map(|()| Uid::unique());
        let [a, b, c, other] = uids;
        let texts = uids.map(|uid| uid.to_string());
        let named = value(Some(&texts[2]), &[&texts[0], &texts[1]], None);
        for (uid, hosted, expected) in [
            (a, Some(c), Some(true)),
            (a, Some(b), Some(true)),
            (a, None, Some(true)),
            (b, Some(a), Some(false)),
            (c, Some(a), Some(false)),
            (c, None, Some(false)),
            (other, Some(a), Some(false)),
            (other, Some(c), None),
            (other, None, None),
        ] {
            assert_eq!(named.is_past(uid, hosted), expected, "{uid} {hosted:?}");
        }
    }

    #[test]
    fn a_value_follows_those_from_which_it_can_have_been_made() {
        // Each is made from the one before it.
        let history = [
            value(Some("a"), &[], None),
            value(Some("a"), &[], Some(3)),
            value(None, &["a"], None),
            value(Some("b"), &["a"], None),
            value(Some("c"), &["a", "b"], None),
        ];
        for (at, before) in history.iter().enumerate() {
            for (other, after) in history.iter().enumerate() {
                assert_eq!(after.follows(before), at <= other, "{before:?} {after:?}");
            }
        }
        let another = value(Some("d"), &[], None);
        assert!(
            !history
                .iter()
                .any(|it| it.follows(&another) || another.follows(it))
        );
    }

    #[test]
    fn a_value_follows_one_whose_oldest_uids_it_has_forgotten() {
        let uids: Vec<String> = (0..=MAX_DELETED).map(|uid| uid.to_string()).collect();
        let before = CatalogueValue {
            deleted: uids[..MAX_DELETED].to_vec(),
            ..value(Some(&uids[MAX_DELETED]), &[], None)
        };
        let after = CatalogueValue {
            deleted: newest(uids),
            ..value(Some("new"), &[], None)
        };
        assert!(after.follows(&before) && !before.follows(&after));
    }
}
