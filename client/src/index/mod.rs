//! An index as a planner holds it: see [`Index`].
//!
//! One type, three forms behind the trait [`NearestNeighbors`]: `memory`, `shared` and `remote`. `local` holds points
//! in this process, for the first two; `history` knows the newest changes, and `merger` has the two threads that merge.

mod history;
mod local;
mod memory;
mod merger;
mod origin;
mod point;
#[cfg(feature = "net")]
mod remote;
mod rows;
#[cfg(feature = "net")]
mod runtime;
mod scan;
mod search;
#[cfg(feature = "net")]
mod server_methods;
#[cfg(feature = "net")]
mod shared;
#[cfg(feature = "net")]
mod wait;

pub use point::{Changes, InsertOptions, InsertedPoint, SearchResult, StoredPoint, StoredPoints};
#[cfg(feature = "net")]
pub use remote::OpenRemote;
pub use search::Search;
#[cfg(feature = "net")]
pub use shared::{ConnectionStatus, Meanwhile, MeanwhileAnswers, OpenShared, UnsentWrite};
#[cfg(feature = "net")]
pub use wait::set_interrupt_check;

use std::sync::Arc;

use wayfold_index::{NearestNeighbors, Neighbor, ReadRevision, Space};

use crate::{
    Error, Radius, State,
    layout::{self, Coordinate},
};
use memory::{Memory, Merges};

/// A dynamic set of states with exact nearest-neighbour search, for planners.
///
/// Clones share the points. All methods take `&self`, from any number of threads. States are checked and brought into
/// canonical form on their way in; a wrong width, a NaN or a quaternion that is not one is an error and changes
/// nothing.
///
/// ```
/// use wayfold::{Index, InsertOptions, Search};
///
/// let index = Index::in_memory(&"R3*SO3:0.15".parse()?)?;
/// let start = index.insert([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])?;
/// let pose = [0.4, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];
/// let nearest = index.nearest(pose)?.expect("the index has a point");
/// assert_eq!(nearest.id, start);
/// // Stores the pose and finds the ten nearest before it at once.
/// let inserted = index.insert_with(pose, InsertOptions::new().tag(1).neighbors(Search::k(10)))?;
/// assert_eq!(inserted.neighbors.nearest(), Some(nearest));
/// assert!(inserted.neighbors.iter().eq([nearest]));
/// assert!(inserted.neighbors.ids().eq([nearest.id]));
/// assert!(inserted.neighbors.distances().eq([nearest.distance]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Index {
    form: Arc<dyn NearestNeighbors<Error = Error>>,
    /// What `form` holds, if it is the shared one.
    #[cfg(feature = "net")]
    shared: Option<Arc<shared::Core>>,
    /// How the payloads of a remote index hold edges. `shared` knows it for a shared index, which may be made again.
    #[cfg(feature = "net")]
    payload_encoding: crate::PayloadEncoding,
    /// The kinds of the numbers of a state.
    coordinates: Arc<[Coordinate]>,
}

impl Index {
    /// An empty index in this process, without a server. Two threads of this process, which all indices share, merge
    /// the levels of its trees and swap the results in.
    ///
    /// # Errors
    /// None today.
    pub fn in_memory(space: &Space) -> Result<Index, Error> {
        Ok(Index::of(Memory::new(space, Merges::Background)))
    }

    /// Acts like [`Index::in_memory`], but starts no thread: an insert that fills the growing tree merges it itself. Most
    /// inserts take a microsecond, and one in thousands takes as long as building a tree of a part of or all points.
    ///
    /// # Errors
    /// None today.
    pub fn in_memory_inline(space: &Space) -> Result<Index, Error> {
        Ok(Index::of(Memory::new(space, Merges::Inline)))
    }

    fn of(form: Arc<dyn NearestNeighbors<Error = Error>>) -> Index {
        Index {
            coordinates: layout::coordinates(form.space()).into(),
            form,
            #[cfg(feature = "net")]
            shared: None,
            #[cfg(feature = "net")]
            payload_encoding: crate::PayloadEncoding::Unspecified,
        }
    }

    /// The space of the states.
    pub fn space(&self) -> &Space {
        self.form.space()
    }

    /// The number of points.
    ///
    /// # Errors
    /// The index cannot be read: [`Error::Forked`] in a forked process, [`Error::Ended`] if a shared index is gone. A remote
    /// index returns every error of its call to the server.
    pub fn len(&self) -> Result<usize, Error> {
        self.form.len()
    }

    /// True if there are no points.
    ///
    /// # Errors
    /// Those of [`Index::len`].
    pub fn is_empty(&self) -> Result<bool, Error> {
        self.form.is_empty()
    }

    /// Stores a state and returns its id.
    ///
    /// # Errors
    /// [`Error::Width`], [`Error::Layout`], [`Error::State`]: it is no state of the space. [`Error::Forked`]. A shared index
    /// cannot be written: [`Error::Timeout`] if no room or no id came free, [`Error::WritesRefused`], [`Error::Closed`],
    /// [`Error::Ended`]. A remote index returns every error of its call to the server.
    pub fn insert(&self, state: impl State) -> Result<u64, Error> {
        let mut found = Vec::new();
        let options = InsertOptions::new();
        let inserted = self.with_row(state, |row| {
            self.form.insert(&options.point(row), None, &mut found)
        });
        Ok(inserted?.0)
    }

    /// Stores a state with a tag, a payload or an id, and answers a search of the points before it at once.
    ///
    /// # Errors
    /// Those of [`Index::insert`] and of [`Index::search`]. [`Error::IdTaken`]: a point has the id.
    pub fn insert_with<S: State>(
        &self,
        state: S,
        options: InsertOptions<'_>,
    ) -> Result<InsertedPoint, Error> {
        let scaled = options.search.as_ref().map(Search::scaled).transpose()?;
        let mut neighbors = Vec::new();
        let (id, read_revision) = self.with_row(state, |row| {
            self.form
                .insert(&options.point(row), scaled.as_ref(), &mut neighbors)
        })?;
        Ok(InsertedPoint {
            id,
            neighbors: SearchResult {
                neighbors,
                read_revision,
            },
        })
    }

    /// Stores many states at once, and returns their ids, which ascend.
    ///
    /// # Errors
    /// Those of [`Index::insert`]; the row in the error is the state's. Nothing is stored then, with two exceptions. With
    /// [`Error::Partial`], the rows before the failed part are stored, under the ids in the error. In a remote index the
    /// rows of the failed part, all of them if it is not `Partial`, may be stored too after [`Error::Timeout`],
    /// [`Error::Connection`], [`Error::Interrupted`], and a refusal with `DEADLINE_EXCEEDED`, `CANCELLED`, `UNKNOWN`,
    /// `INTERNAL`, `DATA_LOSS` or `UNAVAILABLE`: look before you repeat them. If the server refused writes of a shared
    /// index, those of them that it had not taken are in [`Index::take_unsent`] instead; if the index was closed
    /// meanwhile, in the result of [`Index::close`].
    pub fn insert_many<S: State>(
        &self,
        states: impl IntoIterator<Item = S>,
    ) -> Result<Vec<u64>, Error> {
        self.with_rows(states, |rows| self.form.insert_many(rows))
    }

    /// Removes a point. False if there is none with this id.
    ///
    /// # Errors
    /// The index cannot be written.
    pub fn remove(&self, id: u64) -> Result<bool, Error> {
        self.form.remove(id)
    }

    /// Moves a point to another state; it keeps its tag and loses its payload. False if there is none with this id.
    /// A remote index makes two calls: a tag that another process sets between them is lost, and a removal is undone.
    ///
    /// # Errors
    /// Those of [`Index::insert`].
    pub fn replace(&self, id: u64, state: impl State) -> Result<bool, Error> {
        self.with_row(state, |row| self.form.replace(id, row))
    }

    /// Sets the tag of a point. False if there is none with this id.
    ///
    /// # Errors
    /// The index cannot be written.
    pub fn set_tag(&self, id: u64, tag: u64) -> Result<bool, Error> {
        self.form.set_tag(id, tag)
    }

    /// Sets the payload of a point; its state and its tag stay. False if there is none with this id.
    ///
    /// # Errors
    /// [`Error::Argument`], or a refusal of the server: it has more than 64 KiB, the most that a server takes. In
    /// memory there is no limit. The index cannot be written.
    pub fn set_payload(&self, id: u64, payload: &[u8]) -> Result<bool, Error> {
        self.form.set_payload(id, payload)
    }

    /// The point with this id.
    ///
    /// # Errors
    /// Those of [`Index::len`].
    pub fn get(&self, id: u64) -> Result<Option<StoredPoint>, Error> {
        Ok(self.form.get(id)?.map(StoredPoint::from))
    }

    /// The payload of the point with this id: empty if it has none, `None` if there is no such point.
    ///
    /// # Errors
    /// Those of [`Index::len`]; a shared index also asks the server.
    pub fn payload(&self, id: u64) -> Result<Option<Vec<u8>>, Error> {
        self.form.payload(id)
    }

    /// The payloads of the points with these ids, in their order: empty if a point has none, `None` if
    /// there is no such point. A shared index asks the server once for a thousand of them.
    ///
    /// # Errors
    /// Those of [`Index::payload`].
    pub fn payloads(&self, ids: &[u64]) -> Result<Vec<Option<Vec<u8>>>, Error> {
        self.form.payloads(ids)
    }

    /// The nearest point; `None` if there are no points.
    ///
    /// # Errors
    /// Those of [`Index::search`].
    pub fn nearest(&self, state: impl State) -> Result<Option<Neighbor>, Error> {
        let mut found = Vec::new();
        self.ask(state, &search::nearest_k(1), &mut found)?;
        Ok(found.first().copied())
    }

    /// The `k` nearest points, nearest first.
    ///
    /// # Errors
    /// Those of [`Index::search`].
    pub fn nearest_k(&self, state: impl State, k: u32) -> Result<Vec<Neighbor>, Error> {
        Ok(self.search(state, &Search::k(k))?.neighbors)
    }

    /// All points at distance `radius` or nearer, nearest first: a number, or a [`ScaledRadius`](crate::ScaledRadius).
    ///
    /// # Errors
    /// Those of [`Index::search`].
    pub fn nearest_r(
        &self,
        state: impl State,
        radius: impl Into<Radius>,
    ) -> Result<Vec<Neighbor>, Error> {
        Ok(self.search(state, &Search::within(radius))?.neighbors)
    }

    /// Answers any search.
    ///
    /// # Errors
    /// [`Error::Width`], [`Error::Layout`], [`Error::State`]: it is no state of the space. [`Error::Argument`]: a
    /// number of the search is out of its range. [`Error::SearchTimeout`]. The index cannot be read: those of
    /// [`Index::len`].
    pub fn search<S: State>(&self, state: S, search: &Search) -> Result<SearchResult, Error> {
        let mut neighbors = Vec::new();
        let read_revision = self.ask(state, &search.scaled()?, &mut neighbors)?;
        Ok(SearchResult {
            neighbors,
            read_revision,
        })
    }

    /// Answers any search into the caller's buffer, in place of its content.
    ///
    /// # Errors
    /// Those of [`Index::search`].
    pub fn search_into<S: State>(
        &self,
        state: S,
        search: &Search,
        found: &mut Vec<Neighbor>,
    ) -> Result<ReadRevision, Error> {
        self.ask(state, &search.scaled()?, found)
    }

    /// Answers a search of many states, which see the same points. A remote index divides more than 1,000 states, or a
    /// large answer, among calls, which may see different revisions: take the least for [`Search::since`].
    ///
    /// # Errors
    /// Those of [`Index::search`] for any of the states.
    pub fn search_many<S: State>(
        &self,
        states: impl IntoIterator<Item = S>,
        search: &Search,
    ) -> Result<Vec<SearchResult>, Error> {
        let scaled = search.scaled()?;
        self.with_rows(states, |rows| self.ask_many(rows, &[scaled]))
    }

    /// Answers a search for each of many states, which see the same points. A remote index takes only one search.
    ///
    /// # Errors
    /// Those of [`Index::search`] for any of the states; there are not as many searches as states, or several for a
    /// remote index.
    pub fn search_each<S: State>(
        &self,
        states: impl IntoIterator<Item = S>,
        searches: &[Search],
    ) -> Result<Vec<SearchResult>, Error> {
        let scaled: Vec<_> = searches
            .iter()
            .map(Search::scaled)
            .collect::<Result<_, _>>()?;
        self.with_rows(states, |rows| {
            let count = rows.len() / self.space().coordinates();
            match scaled.len() == count {
                true if count == 0 => Ok(Vec::new()),
                true => self.ask_many(rows, &scaled),
                false => Err(Error::Argument {
                    field: "searches",
                    problem: format!("{} of them for {count} states", scaled.len()),
                }),
            }
        })
    }

    /// All points as they are now, by ascending id.
    ///
    /// # Errors
    /// Those of [`Index::len`].
    pub fn scan(&self) -> Result<StoredPoints, Error> {
        self.form.scan().map(StoredPoints)
    }

    /// Everything that changed after the revision that an earlier answer read, by any thread or process. `None` if the
    /// index has forgotten some of it, as after 65,536 changes: scan it then, after a search, whose revision is the next
    /// `since`.
    ///
    /// # Errors
    /// Those of [`Index::len`]. `UID_MISMATCH`: a remote index was made again.
    pub fn changes(&self, since: ReadRevision) -> Result<Option<Changes>, Error> {
        let changes = self.form.changes(since)?;
        Ok(changes.map(|changes| Changes {
            stored: changes
                .stored
                .iter()
                .map(|point| point.to_point().into())
                .collect(),
            removed: changes.removed,
            read_revision: changes.read_revision,
        }))
    }

    /// Forgets all points of an index in memory; their ids stay used.
    ///
    /// # Errors
    /// [`Error::NotInMemory`]: others may use its points.
    pub fn clear(&self) -> Result<(), Error> {
        self.form.clear()
    }

    /// Removes all points that the index has now, for everybody. It reads all their ids first: the server does not keep the
    /// points of a scan for as long as their removal may take.
    ///
    /// # Errors
    /// Those of [`Index::scan`] and [`Index::remove`]. Some points may be removed then.
    pub fn remove_all(&self) -> Result<(), Error> {
        let ids = self.form.scan()?.map(|point| point.map(|point| point.id));
        let ids = ids.collect::<Result<Vec<u64>, Error>>()?;
        self.form.remove_many(&ids)
    }
}
