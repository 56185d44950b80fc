//! The form of an index without a copy: each call goes to the server.

mod open;

use std::{
    collections::{BTreeMap, VecDeque},
    sync::mpsc,
};

use wayfold_index::{
    Changes, NearestNeighbors, Neighbor, NewPoint, Point, PointRef, Points, ReadRevision,
    ScaledSearch, ScannedPoints, Space,
};

use super::{
    local::check_id,
    runtime::{check_process, spawn, wait_for},
    wait,
};
use crate::{
    Code, Error, Filter, Include, IndexHandle, NeighborSpec, Neighbors, Outcome, Radius,
    ResetReason, ScaledRadius, WatchEvent,
    search::{Bounds, K},
};

pub use open::OpenRemote;

/// An index on a server.
#[derive(Debug)]
pub(super) struct Remote {
    index: IndexHandle,
}

impl Remote {
    fn filter(&self, scaled: &ScaledSearch<'_>) -> Filter {
        let filter = scaled.search.filter;
        let tagged = Filter::default().tag(filter.tag_mask, filter.tag_value);
        match filter.since_revision {
            0 => tagged,
            since => tagged.since(self.index.revision_at(since)),
        }
    }

    /// The answers to a search about rows, one after the other.
    fn ask(&self, rows: &[f64], scaled: &ScaledSearch<'_>) -> Result<Neighbors, Error> {
        let until = scaled.search.until;
        let index = match until {
            Some(until) => self.index.until(until),
            None => self.index.clone(),
        };
        let rows: Vec<Vec<f64>> = self.rows(rows).collect();
        let (filter, epsilon) = (self.filter(scaled), scaled.search.epsilon);
        let Bounds { k, radius } = bounds(scaled);
        let answered = wait_for(async move {
            let Some(k) = k else {
                let radius = radius.unwrap_or(Radius::Fixed(f64::INFINITY));
                return index
                    .query(&rows, radius)
                    .filter(filter)
                    .epsilon(epsilon)
                    .await;
            };
            let knn = index.knn(&rows).filter(filter).epsilon(epsilon);
            let knn = match k {
                K::Fixed(k) => knn.k(k),
                K::Scaled(factor) => knn.k_factor(factor),
            };
            match radius {
                Some(radius) => knn.radius(radius).await,
                None => knn.await,
            }
        });
        match answered {
            // The client or the server has noticed it first.
            Err(error) if until.is_some() && error.code() == Code::DeadlineExceeded => {
                Err(Error::SearchTimeout)
            }
            answered => answered,
        }
    }

    fn rows(&self, rows: &[f64]) -> impl Iterator<Item = Vec<f64>> {
        let rows = rows.chunks_exact(self.index.coordinates());
        rows.map(<[f64]>::to_vec)
    }

    /// The points of these ids with some columns, or none if the id is not stored.
    fn point(&self, id: u64, include: Include) -> Result<Option<crate::Points>, Error> {
        let index = self.index.clone();
        found(id, async move { index.get([id]).include(include).await })
    }
}

/// Makes a call about the point of this id; None if there is none.
fn found<T: Send + 'static>(
    id: u64,
    call: impl Future<Output = Result<T, Error>> + Send + 'static,
) -> Result<Option<T>, Error> {
    // The server refuses the ids that no point can have.
    if id >= wayfold_proto::END_OF_IDS {
        return Ok(None);
    }
    match wait_for(call) {
        Err(error)
            if error.code() == Code::NotFound && error.reason() == Some("POINTS_NOT_FOUND") =>
        {
            Ok(None)
        }
        answer => answer.map(Some),
    }
}

/// The number of neighbours and the radius of a search, as they travel.
fn bounds(scaled: &ScaledSearch<'_>) -> Bounds {
    let (search, scaling) = (&scaled.search, scaled.scaling);
    let fixed_k = (search.k < usize::MAX).then(|| u32::try_from(search.k).unwrap_or(u32::MAX));
    let fixed_radius = (search.radius < f64::INFINITY).then_some(search.radius);
    let scaled_radius = scaling.radius_factor.map(|factor| {
        let radius = ScaledRadius::new(factor);
        scaling.radius_max.map_or(radius, |max| radius.max(max))
    });
    Bounds {
        k: scaling.k_factor.map(K::Scaled).or(fixed_k.map(K::Fixed)),
        radius: scaled_radius
            .map(Radius::Scaled)
            .or(fixed_radius.map(Radius::Fixed)),
    }
}

impl NearestNeighbors for Remote {
    type Error = Error;

    fn space(&self) -> &Space {
        self.index.space()
    }

    fn len(&self) -> Result<usize, Error> {
        let index = self.index.clone();
        let info = wait_for(async move { index.info().await })?;
        self.index.see_revision(&info.revision)?;
        Ok(info.point_count as usize)
    }

    fn search(
        &self,
        row: &[f64],
        scaled: &ScaledSearch<'_>,
        found: &mut Vec<Neighbor>,
    ) -> Result<ReadRevision, Error> {
        let answer = self.ask(row, scaled)?;
        found.clear();
        found.extend(answer.row(0).iter());
        Ok(ReadRevision(answer.revision().number))
    }

    fn search_many(
        &self,
        rows: &[f64],
        searches: &[ScaledSearch<'_>],
    ) -> Result<Vec<(Vec<Neighbor>, ReadRevision)>, Error> {
        let [scaled] = searches else {
            return Err(Error::Argument {
                field: "searches",
                problem: "a remote index answers one search a call; use search_many".to_owned(),
            });
        };
        let answer = self.ask(rows, scaled)?;
        let revisions = (0..answer.len()).map(|i| ReadRevision(answer.revision_of(i).number));
        let rows = answer.rows().map(|row| row.iter().collect());
        Ok(rows.zip(revisions).collect())
    }

    fn insert(
        &self,
        point: &NewPoint<'_>,
        scaled: Option<&ScaledSearch<'_>>,
        found: &mut Vec<Neighbor>,
    ) -> Result<(u64, ReadRevision), Error> {
        check_id(point)?;
        let mut insert = self.index.insert([point.row]).tags([point.tag]);
        if let Some(id) = point.id {
            insert = insert.ids([id]);
        }
        if !point.payload.is_empty() {
            insert = insert.payloads([point.payload.to_vec()]);
        }
        if let Some(scaled) = scaled {
            let Bounds { k, radius } = bounds(scaled);
            let radius = radius.or(k.is_none().then_some(Radius::Fixed(f64::INFINITY)));
            let spec = NeighborSpec::of(k, radius).filter(self.filter(scaled));
            insert = insert.neighbors(spec);
        }
        let taken = |id| Error::IdTaken { id };
        let answer = wait_for(async move { insert.await }).map_err(|error| match point.id {
            Some(id) if error.code() == Code::AlreadyExists => taken(id),
            _ => error,
        })?;
        let id = match answer.outcomes.first() {
            Some(Outcome::Inserted { id }) => *id,
            Some(Outcome::Unchanged { id }) => return Err(taken(*id)),
            other => {
                return Err(Error::protocol("insert", format!("the outcome {other:?}")));
            }
        };
        found.clear();
        if let Some(neighbors) = &answer.neighbors {
            found.extend(neighbors.row(0).iter());
        }
        Ok((id, ReadRevision(answer.revision.number)))
    }

    fn insert_many(&self, rows: &[f64]) -> Result<Vec<u64>, Error> {
        let rows: Vec<Vec<f64>> = self.rows(rows).collect();
        let insert = self.index.insert(&rows);
        let answer = wait_for(async move { insert.await })?;
        Ok(answer
            .outcomes
            .iter()
            .filter_map(|outcome| outcome.id())
            .collect())
    }

    fn replace(&self, id: u64, row: &[f64]) -> Result<bool, Error> {
        let Some(points) = self.point(id, Include::none().tags())? else {
            return Ok(false);
        };
        let insert = self
            .index
            .insert([row])
            .ids([id])
            .tags([points.point(0).tag])
            .replace();
        wait_for(async move { insert.await })?;
        Ok(true)
    }

    fn remove(&self, id: u64) -> Result<bool, Error> {
        let remove = self.index.remove([id]);
        let removed = found(id, async move { remove.await })?;
        Ok(removed.is_some_and(|removed| removed.removed_count > 0))
    }

    fn remove_many(&self, ids: &[u64]) -> Result<(), Error> {
        if ids.is_empty() {
            return Ok(());
        }
        let remove = self.index.remove(ids);
        wait_for(async move { remove.await.map(drop) })
    }

    fn set_tag(&self, id: u64, tag: u64) -> Result<bool, Error> {
        let update = self.index.update([id]).tags([tag]);
        Ok(found(id, async move { update.await })?.is_some())
    }

    fn set_payload(&self, id: u64, payload: &[u8]) -> Result<bool, Error> {
        let update = self.index.update([id]).payloads([payload.to_vec()]);
        Ok(found(id, async move { update.await })?.is_some())
    }

    fn get(&self, id: u64) -> Result<Option<Point>, Error> {
        let points = self.point(id, Include::points())?;
        Ok(points.map(|points| {
            let point = points.point(0);
            Point {
                id,
                tag: point.tag,
                revision: point.revision,
                row: point.state.to_vec(),
            }
        }))
    }

    fn payload(&self, id: u64) -> Result<Option<Vec<u8>>, Error> {
        let points = self.point(id, Include::none().payloads())?;
        Ok(points.map(|points| {
            points
                .point(0)
                .payload
                .map_or_else(Vec::new, |it| it.to_vec())
        }))
    }

    fn scan(&self) -> Result<ScannedPoints<Error>, Error> {
        // Parts that wait for the caller.
        const MAX_PARTS: usize = 2;
        let (send, receive) = mpsc::sync_channel(MAX_PARTS);
        let index = self.index.clone();
        spawn(async move {
            let mut scan = match index.scan().await {
                Ok(scan) => scan,
                Err(error) => {
                    let _ = send.send(Err(error));
                    return;
                }
            };
            while let Some(part) = scan.next().await.transpose() {
                let is_last = part.is_err();
                // A slow caller blocks this task, and the connection once several have answers that wait.
                let sent = tokio::task::block_in_place(|| send.send(part).is_ok());
                if is_last || !sent {
                    return;
                }
            }
        })?;
        let mut part = VecDeque::new();
        Ok(Box::new(std::iter::from_fn(move || {
            while part.is_empty() {
                if let Err(error) = check_process() {
                    return Some(Err(error));
                }
                match wait::receive(&receive) {
                    Ok(Some(Ok(points))) => part.extend(points.iter().map(|point| Point {
                        id: point.id,
                        tag: point.tag,
                        revision: point.revision,
                        row: point.state.to_vec(),
                    })),
                    Ok(Some(Err(error))) | Err(error) => return Some(Err(error)),
                    Ok(None) => return None,
                }
            }
            part.pop_front().map(Ok)
        })))
    }

    fn changes(&self, since: ReadRevision) -> Result<Option<Changes>, Error> {
        let (index, timeout) = (self.index.clone(), self.index.timeout());
        let reading = async move {
            let mut watch = index.watch().after(index.revision_at(since.0)).await?;
            // The server may lag behind one that answered this client before.
            let newest = watch.newest().number.max(index.revision().number);
            let (mut changed, mut revision) = (BTreeMap::new(), since.0);
            loop {
                // Of an index that was made again the server sends only a reset, and no newer revision.
                let event = match watch.ready() {
                    None if revision >= newest => break,
                    None => watch.next().await?,
                    event => event,
                };
                match event {
                    Some(WatchEvent::Mutation(mutation)) => {
                        revision = mutation.revision.number;
                        changed.extend(mutation.removed_ids.iter().map(|&id| (id, None)));
                        changed.extend(mutation.stored.iter().map(|point| {
                            let state = point.state.to_vec();
                            (point.id, Some((point.tag, point.revision, state)))
                        }));
                    }
                    Some(WatchEvent::Reset(reset)) if reset.reason == ResetReason::UidChanged => {
                        index.revision_at(since.0).check_uid(&reset.revision.uid)?;
                        return Ok(None);
                    }
                    Some(WatchEvent::Reset(_)) | None => return Ok(None),
                }
            }
            let mut changes = Changes {
                stored: Points::new(index.coordinates()),
                removed: Vec::new(),
                read_revision: ReadRevision(revision),
            };
            for (id, point) in changed {
                match point {
                    None => changes.removed.push(id),
                    Some((tag, revision, row)) => changes.stored.push_point(PointRef {
                        id,
                        tag,
                        revision,
                        row: &row,
                    }),
                }
            }
            Ok(Some(changes))
        };
        wait_for(async move {
            let read = tokio::time::timeout(timeout, reading).await;
            read.unwrap_or_else(|_| Err(Error::timeout("watch", timeout)))
        })
    }

    fn clear(&self) -> Result<(), Error> {
        Err(Error::NotInMemory { call: "clear" })
    }
}
