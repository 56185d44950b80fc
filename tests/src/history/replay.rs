//! The contents of reads against a replay of the mutations in the order of their revisions.

use std::collections::{BTreeMap, BTreeSet, HashMap, hash_map::Entry};

use super::{
    Answer, Call, Operation, Point, ReadPoints, Step, Violation,
    changes::{Changes, Position},
    order::Returned,
    placed::Placed,
};

/// Compares all reads, records and refusals, and the answers without effect, with the replay. Returns the number of mutations
/// without an answer that took effect.
pub(super) fn check(
    operations: &[Operation],
    placed: &Placed,
    returned: &[Returned],
) -> Result<u64, Vec<Violation>> {
    let (mut mutations, mut observations, mut unplaced) = (BTreeMap::new(), Vec::new(), Vec::new());
    for (at, operation) in operations.iter().enumerate() {
        let (steps, revision) = match &operation.call {
            Call::Conflict { .. } => continue,
            Call::Read { revision, .. }
            | Call::Record { revision, .. }
            | Call::Mutation {
                answer:
                    Some(Answer {
                        revision,
                        changed: false,
                    }),
                ..
            } => {
                observations.push((*revision, operation));
                continue;
            }
            Call::Mutation { steps, answer } => {
                let revision = answer.map_or_else(|| placed.revision(at), |it| Some(it.revision));
                (steps, revision)
            }
        };
        match revision {
            Some(revision) => {
                let position = Position {
                    revision,
                    lowest: revision,
                    invoked: operation.invoked,
                };
                if mutations.insert(revision, (position, steps)).is_some() {
                    return Err(vec![Violation::Divergent { revision }]);
                }
            }
            None => unplaced.push(Unplaced {
                invoked: operation.invoked,
                newest: returned[at].newest,
                steps,
            }),
        }
    }
    observations.sort_by_key(|(revision, _)| *revision);
    let mut replay = Replay::new(placed, unplaced, Changes::new(operations));
    let mut mutations = mutations.into_iter().peekable();
    let mut violations = Vec::new();
    for (revision, operation) in observations {
        while let Some((_, (position, steps))) = mutations.next_if(|(at, _)| *at <= revision) {
            replay.apply(position, steps);
        }
        let answer = Observed {
            revision,
            returned: operation.returned,
            is_record: matches!(operation.call, Call::Record { .. }),
        };
        let compared = match &operation.call {
            Call::Read { seen, .. } => replay.compare(answer, seen),
            Call::Record {
                stored, removed, ..
            } => replay.compare_record(answer, stored, removed),
            Call::Mutation { steps, .. } => replay.compare_unchanged(answer, steps),
            Call::Conflict { .. } => Ok(()),
        };
        violations.extend(compared.err());
    }
    for (_, (position, steps)) in mutations {
        replay.apply(position, steps);
    }
    violations.append(&mut replay.changes.violations);
    violations.extend(operations.iter().filter_map(|it| replay.unprovoked(it)));
    match violations.is_empty() {
        true => Ok(replay.found),
        false => Err(violations),
    }
}

/// An answer with a revision, as the replay compares it.
#[derive(Clone, Copy)]
struct Observed {
    revision: u64,
    returned: u64,
    /// True if it tells what the mutation of its revision did, and not what all up to it did.
    is_record: bool,
}

/// The state of the replay at one revision.
struct Replay<'a> {
    placed: &'a Placed,
    points: HashMap<u64, Stored>,
    /// The id of each payload that is stored.
    payloads: HashMap<u64, u64>,
    /// The revisions that removed points.
    removed: HashMap<u64, u64>,
    /// The coordinates that were seen of a point, by its id and the revision that stored it.
    states: HashMap<(u64, u64), u64>,
    unplaced: Vec<Unplaced<'a>>,
    found: u64,
    /// The revision of a mutation with a point that no read told.
    torn: Option<u64>,
    changes: Changes,
    /// The newest revision that was applied, and the points that it changed.
    touched: (u64, BTreeSet<u64>),
}

/// A mutation without an answer whose payloads were in no answer.
struct Unplaced<'a> {
    invoked: u64,
    /// The greatest revision that had returned then; its own is greater.
    newest: u64,
    steps: &'a [Step],
}

/// A point of the replay.
#[derive(Clone, Copy)]
struct Stored {
    tag: u64,
    payload: u64,
    stored: u64,
}

impl<'a> Replay<'a> {
    fn new(placed: &'a Placed, unplaced: Vec<Unplaced<'a>>, changes: Changes) -> Self {
        Self {
            placed,
            points: HashMap::new(),
            payloads: HashMap::new(),
            removed: HashMap::new(),
            states: HashMap::new(),
            unplaced,
            found: placed.count(),
            torn: None,
            changes,
            touched: (0, BTreeSet::new()),
        }
    }

    fn apply(&mut self, position: Position, steps: &[Step]) {
        let revision = position.revision;
        if self.touched.0 != revision {
            self.touched = (revision, BTreeSet::new());
        }
        for step in steps {
            let changed = match *step {
                Step::Put { id, tag, payload } => {
                    let Some(id) = id.or_else(|| self.placed.id(payload)) else {
                        self.torn = Some(revision);
                        continue;
                    };
                    let stored = Stored {
                        tag,
                        payload,
                        stored: revision,
                    };
                    self.forget(id);
                    self.points.insert(id, stored);
                    self.payloads.insert(payload, id);
                    Some(id)
                }
                Step::Remove(id) => {
                    let is_stored = self.forget(id);
                    if is_stored {
                        self.removed.insert(id, revision);
                    }
                    is_stored.then_some(id)
                }
                Step::SetTag(id, tag) => self.set_tag(id, tag),
                Step::SetTagIf {
                    id,
                    tag,
                    if_revision,
                } => {
                    self.changes.compare(id, if_revision, revision);
                    self.set_tag(id, tag)
                }
            };
            if let Some(id) = changed {
                self.changes.note(id, position);
                self.touched.1.insert(id);
            }
        }
    }

    /// Returns the point if its tag changes.
    fn set_tag(&mut self, id: u64, tag: u64) -> Option<u64> {
        let stored = self.points.get_mut(&id)?;
        (std::mem::replace(&mut stored.tag, tag) != tag).then_some(id)
    }

    fn forget(&mut self, id: u64) -> bool {
        let stored = self.points.remove(&id);
        if let Some(stored) = &stored {
            self.payloads.remove(&stored.payload);
        }
        stored.is_some()
    }

    /// Compares one answer with the replay at its revision.
    fn compare(&mut self, answer: Observed, seen: &ReadPoints) -> Result<(), Violation> {
        if let ReadPoints::All(points) = seen {
            self.find_removals(answer, points);
        }
        for (&id, point) in seen.points() {
            self.compare_point(answer, id, *point)?;
        }
        let ReadPoints::All(points) = seen else {
            return Ok(());
        };
        // Nobody removes a point whose id nobody knows.
        if let Some(revision) = self.torn {
            return Err(Violation::Torn { revision });
        }
        let missing = self.points.iter().find(|(id, _)| !points.contains_key(id));
        match missing {
            None => Ok(()),
            Some((&id, stored)) => Err(Violation::Lost {
                read: answer.revision,
                id,
                revision: stored.stored,
            }),
        }
    }

    /// Compares a record with the effects of the mutation of its revision.
    fn compare_record(
        &mut self,
        answer: Observed,
        stored: &BTreeMap<u64, Point>,
        removed: &BTreeSet<u64>,
    ) -> Result<(), Violation> {
        for &id in removed {
            if self.points.contains_key(&id) {
                self.place(answer, |step| *step == Step::Remove(id));
            }
        }
        for (&id, point) in stored {
            self.compare_point(answer, id, *point)?;
        }
        let revision = answer.revision;
        let mut told: BTreeSet<u64> = stored.keys().chain(removed).copied().collect();
        if self.touched.0 == revision {
            // Empty if both are the same, and if no point is both stored and removed.
            told = told
                .symmetric_difference(&self.touched.1)
                .copied()
                .collect();
        }
        let is_both = stored.keys().any(|id| removed.contains(id));
        match told.is_empty() && !is_both {
            true => Ok(()),
            false => Err(Violation::Divergent { revision }),
        }
    }

    /// Compares the steps of a mutation that found nothing to change with the replay at its revision.
    fn compare_unchanged(&mut self, answer: Observed, steps: &[Step]) -> Result<(), Violation> {
        for step in steps {
            // A point that was to be put is too close, or stored as it is: a read finds any other.
            let Some((id, tag)) = step.target() else {
                continue;
            };
            let to_change = |replay: &Self| {
                let stored = replay.points.get(&id).copied();
                stored.filter(|stored| Some(stored.tag) != tag)
            };
            if to_change(self).is_some() {
                let targets = [Some((id, tag)), Some((id, None))];
                self.place(answer, |it| targets.contains(&it.target()));
            }
            if let Some(stored) = to_change(self) {
                return Err(Violation::Lost {
                    read: answer.revision,
                    id,
                    revision: stored.stored,
                });
            }
        }
        Ok(())
    }

    /// The contradiction of a refused compare-and-set: nothing may have changed its point.
    fn unprovoked(&self, operation: &Operation) -> Option<Violation> {
        let Call::Conflict { id, if_revision } = operation.call else {
            return None;
        };
        let returned = operation.returned;
        let may_change = |step: &Step| match step.target() {
            Some((target, _)) => target == id,
            // Without an answer its id is not known.
            None => true,
        };
        let is_provoked = self.changes.provoke(id, if_revision, returned)
            || self
                .unplaced
                .iter()
                .any(|it| it.invoked < returned && it.steps.iter().any(may_change));
        (!is_provoked).then_some(Violation::Unprovoked { id, if_revision })
    }

    /// Places mutations without an answer that remove what an answer lacks.
    fn find_removals(&mut self, answer: Observed, points: &BTreeMap<u64, Point>) {
        if self.unplaced.is_empty() {
            return;
        }
        let stored: Vec<u64> = self.points.keys().copied().collect();
        for id in stored.into_iter().filter(|id| !points.contains_key(id)) {
            self.place(answer, |step| *step == Step::Remove(id));
        }
    }

    /// Applies a mutation without an answer, if one has such a step, was invoked before the answer came and has room for its
    /// revision.
    fn place(&mut self, answer: Observed, is_it: impl Fn(&Step) -> bool) {
        let Observed {
            revision,
            returned,
            is_record,
        } = answer;
        let at = self.unplaced.iter().position(|it| {
            it.invoked < returned && it.newest < revision && it.steps.iter().any(&is_it)
        });
        if let Some(at) = at {
            let unplaced = self.unplaced.remove(at);
            self.found += 1;
            let position = Position {
                revision,
                lowest: if is_record {
                    revision
                } else {
                    unplaced.newest + 1
                },
                invoked: unplaced.invoked,
            };
            self.apply(position, unplaced.steps);
        }
    }

    fn compare_point(&mut self, answer: Observed, id: u64, point: Point) -> Result<(), Violation> {
        let read = answer.revision;
        let Some(mut stored) = self.points.get(&id).copied() else {
            let is_elsewhere = self.payloads.contains_key(&point.payload);
            return Err(match self.removed.get(&id) {
                _ if is_elsewhere => Violation::Twice { revision: read, id },
                Some(&revision) => Violation::Lost { read, id, revision },
                None => Violation::NoPrefix { read, id },
            });
        };
        if stored.tag != point.tag {
            let target = Some((id, Some(point.tag)));
            self.place(answer, |step| step.target() == target);
            stored = self.points.get(&id).copied().unwrap_or(stored);
        }
        if (stored.tag, stored.payload) != (point.tag, point.payload) {
            return Err(match point.stored < stored.stored {
                true => Violation::Lost {
                    read,
                    id,
                    revision: stored.stored,
                },
                false => Violation::NoPrefix { read, id },
            });
        }
        if stored.stored != point.stored {
            let revision = point.stored;
            return Err(Violation::Twice { revision, id });
        }
        match self.states.entry((id, point.stored)) {
            Entry::Vacant(unseen) => {
                unseen.insert(point.state);
            }
            Entry::Occupied(known) if *known.get() == point.state => {}
            Entry::Occupied(_) => return Err(Violation::Divergent { revision: read }),
        }
        Ok(())
    }
}
