//! The completion of milestones, once their places in the order are known.

use std::time::Instant;

use wayfold::Neighbor;

use super::{CheckedState, Worker};
use crate::{
    planning::{
        error::PlanningError, options::TIMEOUT, prm_star::k, problem::Problem, processes::lost,
    },
    rigid::{
        milestone::{self, PENDING},
        replay,
        roadmap::Roadmap,
    },
};

impl Worker<'_> {
    /// The last step: completes the milestones whose places in the order have become known. With `is_waiting` it waits
    /// for one.
    pub async fn settle(&mut self, is_waiting: bool) -> Result<(), PlanningError> {
        let start = Instant::now();
        let taken = match is_waiting {
            true => self.index.wait_meanwhile(TIMEOUT),
            false => self.index.meanwhile(),
        };
        self.account.times.waiting += start.elapsed();
        if is_waiting && taken.answers.is_empty() && taken.open > 0 {
            return Err(lost(self.number, "the server does not take its milestones"));
        }
        for answer in taken.answers {
            let Some(mut unplaced) = self.unplaced.remove(&answer.id) else {
                continue;
            };
            if answer.is_superset {
                self.lost += 1;
                continue;
            }
            let mut near = std::mem::take(&mut unplaced.found);
            near.extend(answer.neighbors);
            near.sort_unstable();
            near.truncate(k(answer.points_before));
            self.complete(answer.id, unplaced.checked, &near).await?;
        }
        if taken.open == 0 {
            self.lost += self.unplaced.len();
            self.unplaced.clear();
        }
        Ok(())
    }

    /// Completes a milestone, whose k(n) nearest earlier ones are `near`.
    pub(super) async fn complete(
        &mut self,
        id: u64,
        mut checked: CheckedState,
        near: &[Neighbor],
    ) -> Result<(), PlanningError> {
        let stored = checked.edges();
        let is_new = |near: &&Neighbor| !checked.motions.contains_key(&near.id);
        self.account.meanwhile += near.iter().filter(is_new).count() as u64;
        self.check(&mut checked, near)?;
        // Nearer ones that arrived meanwhile displace others.
        let is_near = |id: &u64| near.iter().any(|near| near.id == *id);
        checked.motions.retain(|id, _| is_near(id));
        let edges = checked.edges();
        self.account.milestones += 1;
        self.account.edges += edges.len() as u64;
        let changed = (edges != stored).then(|| milestone::payload(&edges));
        let start = Instant::now();
        if self.min_separation > 0.0 {
            self.update(id, changed).await?;
        } else {
            // In this order: a milestone that is not pending has all its edges.
            if let Some(payload) = changed {
                self.index.set_payload(id, &payload)?;
            }
            self.index.set_tag(id, milestone::tag(self.number))?;
        }
        self.account.times.waiting += start.elapsed();
        Ok(())
    }

    /// Marks any worker's milestone as complete, with other edges if there are any.
    async fn update(&self, id: u64, edges: Option<bytes::Bytes>) -> Result<(), PlanningError> {
        let update = self.server.update([id]).tags([0]).tag_mask(PENDING);
        match edges {
            Some(edges) => update.payloads([edges]).await?,
            None => update.await?,
        };
        Ok(())
    }

    /// Checks the motions to these milestones that are not checked yet.
    pub(super) fn check(
        &mut self,
        checked: &mut CheckedState,
        near: &[Neighbor],
    ) -> Result<(), PlanningError> {
        for near in near {
            if checked.motions.contains_key(&near.id) {
                continue;
            }
            self.meet(near.id)?;
            let start = Instant::now();
            let (scene, checks) = (self.scene, &mut self.account.checks);
            let is_free = scene.is_free_way(&checked.state, &self.states[&near.id], checks);
            checked.motions.insert(near.id, is_free);
            self.account.times.checking += start.elapsed();
        }
        Ok(())
    }

    /// Makes sure that the state of a milestone is known.
    fn meet(&mut self, id: u64) -> Result<(), PlanningError> {
        if self.states.contains_key(&id) {
            return Ok(());
        }
        let start = Instant::now();
        let point = self.index.get(id)?.ok_or_else(|| PlanningError::Replay {
            id,
            problem: "it was removed".to_owned(),
        })?;
        self.states.insert(id, point.state);
        self.account.times.searching += start.elapsed();
        Ok(())
    }

    /// Completes all own milestones, and waits until the server has them.
    pub(super) async fn finish(&mut self) -> Result<(), PlanningError> {
        while !self.unplaced.is_empty() {
            self.settle(true).await?;
        }
        let start = Instant::now();
        self.index.flush()?;
        self.account.times.waiting += start.elapsed();
        if self.lost > 0 {
            self.adopt(Some(self.number)).await?;
            self.lost = 0;
        }
        Ok(())
    }

    /// Completes the stored milestones that are pending, those of one worker or of all: with the same result as if
    /// their workers had done it. Returns their number.
    ///
    /// Live workers are not disturbed: they would write the same completion.
    pub async fn adopt(&mut self, of: Option<usize>) -> Result<usize, PlanningError> {
        // The reads that follow see at least this revision.
        self.server.info().await?;
        let roadmap = Roadmap::read(&self.server).await?;
        let mut adopted = 0;
        for at in 0..roadmap.len() {
            let is_wanted = of.is_none_or(|number| number == roadmap.workers[at]);
            if !roadmap.pending[at] || !is_wanted {
                continue;
            }
            let near = replay::nearest_before(self.scene.space(), &roadmap, at);
            let start = Instant::now();
            let checks = &mut self.account.checks;
            let edges = replay::free(self.scene, &roadmap, at, &near, checks);
            self.account.times.checking += start.elapsed();
            self.account.milestones += 1;
            self.account.edges += edges.len() as u64;
            let edges = Vec::from_iter(edges);
            self.update(roadmap.ids[at], Some(milestone::payload(&edges)))
                .await?;
            adopted += 1;
        }
        Ok(adopted)
    }
}
