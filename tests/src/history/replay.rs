//! The contents of reads against a replay of the mutations in the order of their revisions.

use std::collections::{BTreeMap, HashMap, hash_map::Entry};

use super::{Answer, Call, Operation, Point, ReadPoints, Step, Violation, order::Returned};

/// The mutations without an answer whose effect was seen.
#[derive(Default)]
pub(super) struct Placed {
    /// The revision of each, by its place in the history.
    revisions: HashMap<usize, u64>,
    /// The ids of its points, by their payloads.
    ids: HashMap<u64, u64>,
}

impl Placed {
    pub(super) fn revision(&self, at: usize) -> Option<u64> {
        self.revisions.get(&at).copied()
    }

    /// True if the mutation is known to have made its revision.
    pub(super) fn makes_revision(&self, operations: &[Operation], at: usize) -> bool {
        match operations[at].call {
            Call::Mutation {
                answer: Some(answer),
                ..
            } => answer.changed,
            Call::Mutation { answer: None, .. } => self.revisions.contains_key(&at),
            Call::Read { .. } => false,
        }
    }
}

/// Finds the mutations without an answer by the payloads that only they could have stored.
pub(super) fn place(operations: &[Operation]) -> Result<Placed, Vec<Violation>> {
    let mut unknown = HashMap::new();
    for (at, operation) in operations.iter().enumerate() {
        if let Call::Mutation {
            steps,
            answer: None,
        } = &operation.call
        {
            for step in steps {
                if let Step::Put { payload, .. } = step {
                    unknown.insert(*payload, at);
                }
            }
        }
    }
    let mut placed = Placed::default();
    for operation in operations {
        let Call::Read { seen, .. } = &operation.call else {
            continue;
        };
        for (&id, point) in seen.points() {
            let Some(&at) = unknown.get(&point.payload) else {
                continue;
            };
            let revision = *placed.revisions.entry(at).or_insert(point.stored);
            let known = *placed.ids.entry(point.payload).or_insert(id);
            if (revision, known) != (point.stored, id) {
                let revision = point.stored;
                return Err(vec![Violation::Twice { revision, id }]);
            }
        }
    }
    Ok(placed)
}

/// Compares all reads, and the answers without effect, with the replay. Returns the number of mutations without an answer that
/// took effect.
pub(super) fn check(
    operations: &[Operation],
    placed: &Placed,
    returned: &[Returned],
) -> Result<u64, Vec<Violation>> {
    let (mut mutations, mut observations, mut unplaced) = (BTreeMap::new(), Vec::new(), Vec::new());
    for (at, operation) in operations.iter().enumerate() {
        let (steps, revision) = match &operation.call {
            Call::Read { revision, .. }
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
                if mutations.insert(revision, steps).is_some() {
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
    let mut replay = Replay::new(placed, unplaced);
    let mut mutations = mutations.into_iter().peekable();
    let mut violations = Vec::new();
    for (read, operation) in observations {
        while let Some((revision, steps)) = mutations.next_if(|(revision, _)| *revision <= read) {
            replay.apply(revision, steps);
        }
        let compared = match &operation.call {
            Call::Read { seen, .. } => replay.compare(read, operation.returned, seen),
            Call::Mutation { steps, .. } => {
                replay.compare_unchanged(read, operation.returned, steps)
            }
        };
        violations.extend(compared.err());
    }
    match violations.is_empty() {
        true => Ok(replay.found),
        false => Err(violations),
    }
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
    fn new(placed: &'a Placed, unplaced: Vec<Unplaced<'a>>) -> Self {
        Self {
            placed,
            points: HashMap::new(),
            payloads: HashMap::new(),
            removed: HashMap::new(),
            states: HashMap::new(),
            unplaced,
            found: placed.revisions.len() as u64,
            torn: None,
        }
    }

    fn apply(&mut self, revision: u64, steps: &[Step]) {
        for step in steps {
            match *step {
                Step::Put { id, tag, payload } => {
                    let id = id.or_else(|| self.placed.ids.get(&payload).copied());
                    let Some(id) = id else {
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
                }
                Step::Remove(id) => {
                    if self.forget(id) {
                        self.removed.insert(id, revision);
                    }
                }
                Step::SetTag(id, tag) => {
                    if let Some(stored) = self.points.get_mut(&id) {
                        stored.tag = tag;
                    }
                }
            }
        }
    }

    fn forget(&mut self, id: u64) -> bool {
        let stored = self.points.remove(&id);
        if let Some(stored) = &stored {
            self.payloads.remove(&stored.payload);
        }
        stored.is_some()
    }

    /// Compares one answer with the replay at its revision.
    fn compare(&mut self, read: u64, returned: u64, seen: &ReadPoints) -> Result<(), Violation> {
        if let ReadPoints::All(points) = seen {
            self.find_removals(read, returned, points);
        }
        for (&id, point) in seen.points() {
            self.compare_point(read, returned, id, *point)?;
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
                read,
                id,
                revision: stored.stored,
            }),
        }
    }

    /// Compares the steps of a mutation that found nothing to change with the replay at its revision.
    fn compare_unchanged(
        &mut self,
        revision: u64,
        returned: u64,
        steps: &[Step],
    ) -> Result<(), Violation> {
        for step in steps {
            let (id, tag) = match *step {
                // Its point is too close, or stored as it is: a read finds any other.
                Step::Put { .. } => continue,
                Step::Remove(id) => (id, None),
                Step::SetTag(id, tag) => (id, Some(tag)),
            };
            let to_change = |replay: &Self| {
                let stored = replay.points.get(&id).copied();
                stored.filter(|stored| Some(stored.tag) != tag)
            };
            if to_change(self).is_some() {
                let is_before = |it: &Step| it == step || *it == Step::Remove(id);
                self.place(revision, returned, is_before);
            }
            if let Some(stored) = to_change(self) {
                return Err(Violation::Lost {
                    read: revision,
                    id,
                    revision: stored.stored,
                });
            }
        }
        Ok(())
    }

    /// Places mutations without an answer that remove what an answer lacks.
    fn find_removals(&mut self, read: u64, returned: u64, points: &BTreeMap<u64, Point>) {
        if self.unplaced.is_empty() {
            return;
        }
        let stored: Vec<u64> = self.points.keys().copied().collect();
        for id in stored.into_iter().filter(|id| !points.contains_key(id)) {
            self.place(read, returned, |step| *step == Step::Remove(id));
        }
    }

    /// Applies a mutation without an answer, if one has such a step, was invoked before the answer came and has room for its
    /// revision.
    fn place(&mut self, read: u64, returned: u64, is_it: impl Fn(&Step) -> bool) {
        let at = self.unplaced.iter().position(|it| {
            it.invoked < returned && it.newest < read && it.steps.iter().any(&is_it)
        });
        if let Some(at) = at {
            let steps = self.unplaced.remove(at).steps;
            self.found += 1;
            self.apply(read, steps);
        }
    }

    fn compare_point(
        &mut self,
        read: u64,
        returned: u64,
        id: u64,
        point: Point,
    ) -> Result<(), Violation> {
        let Some(mut stored) = self.points.get(&id).copied() else {
            let is_elsewhere = self.payloads.contains_key(&point.payload);
            return Err(match self.removed.get(&id) {
                _ if is_elsewhere => Violation::Twice { revision: read, id },
                Some(&revision) => Violation::Lost { read, id, revision },
                None => Violation::NoPrefix { read, id },
            });
        };
        if stored.tag != point.tag {
            self.place(read, returned, |step| *step == Step::SetTag(id, point.tag));
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
