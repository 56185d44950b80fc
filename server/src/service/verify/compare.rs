//! The first pass: every stored point against the forest's, and the hash of the content.

use sha2::{Digest as _, Sha256};
use wayfold_index::{Point, Space};

use super::{DOING, Disagreements, Pass, sample::Sampler};
use crate::{log::StoredPoint, service::Error};

/// The progress of the pass.
pub(super) struct Comparison {
    after: Option<u64>,
    /// The number of points read.
    pub(super) read: u64,
    hash: Sha256,
    pub(super) sampler: Sampler,
}

impl Comparison {
    /// Before the first point; draws this many of the stored states.
    pub(super) fn new(space: &Space, states: usize, seed: u64) -> Self {
        let text = space.to_string();
        let hash = Sha256::new()
            .chain_update(b"wayfold content 1")
            .chain_update((text.len() as u64).to_le_bytes())
            .chain_update(text);
        Self {
            after: None,
            read: 0,
            hash,
            sampler: Sampler::new(space, states, seed),
        }
    }

    /// Continues to the end (true) or until progress is due (false).
    pub(super) async fn go_on(
        &mut self,
        pass: &Pass<'_>,
        disagreements: &mut Disagreements,
    ) -> Result<bool, Error> {
        let mut pace = pass.call.pace(DOING);
        let mut searched = pass.published.snapshot.points_after(self.after).peekable();
        while pass.has_time() {
            let page = pass.page(self.after).await?;
            if page.is_empty() {
                for point in searched {
                    disagreements.add(|| only_searched(&point));
                    pace.step().await?;
                }
                return Ok(true);
            }
            for stored in &page {
                while let Some(point) = searched.next_if(|point| point.id < stored.id) {
                    disagreements.add(|| only_searched(&point));
                    pace.step().await?;
                }
                match searched.next_if(|point| point.id == stored.id) {
                    Some(point) if is_same(&point, stored) => {}
                    Some(point) => disagreements.add(|| different(&point, stored)),
                    None => disagreements.add(|| {
                        format!("the point with id {} is stored and not searched", stored.id)
                    }),
                }
                self.take(stored);
                // The hash of a payload of 64 KiB takes long.
                pace.step().await?;
            }
        }
        Ok(false)
    }

    fn take(&mut self, point: &StoredPoint) {
        self.hash.update(point.id.to_le_bytes());
        self.hash.update(point.tag.to_le_bytes());
        for coordinate in &point.state {
            self.hash.update(coordinate.to_le_bytes());
        }
        self.hash.update((point.payload.len() as u64).to_le_bytes());
        self.hash.update(&point.payload);
        self.sampler.add(&point.state);
        self.after = Some(point.id);
        self.read += 1;
    }

    /// The hash of the content, at the end.
    pub(super) fn hash(&self) -> [u8; 32] {
        self.hash.clone().finalize().into()
    }
}

fn is_same(searched: &Point, stored: &StoredPoint) -> bool {
    let pairs = || searched.row.iter().zip(&stored.state);
    (searched.tag, searched.revision) == (stored.tag, stored.revision)
        && searched.row.len() == stored.state.len()
        && pairs().all(|(a, b)| a.to_bits() == b.to_bits())
}

fn only_searched(point: &Point) -> String {
    format!("the point with id {} is searched and not stored", point.id)
}

fn different(searched: &Point, stored: &StoredPoint) -> String {
    let what = if searched.tag != stored.tag {
        format!("the tag {}, stored {}", searched.tag, stored.tag)
    } else if searched.revision != stored.revision {
        format!("revision {}, stored {}", searched.revision, stored.revision)
    } else {
        format!("the state {:?}, stored {:?}", searched.row, stored.state)
    };
    format!("the point with id {} is searched with {what}", stored.id)
}
