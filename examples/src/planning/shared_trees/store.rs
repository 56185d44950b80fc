//! The shared store of the workers: the indices that hold the trees, and the meeting.

use clap::ValueEnum;
use wayfold::{Client, Filter, IndexHandle, Space};

use super::{
    super::{error::PlanningError, problem::Problem},
    meeting::Meeting,
    vertex::{self, ROOTS},
};

/// The distinction between the two trees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Layout {
    /// Each has an index of its own
    Indices,
    /// A tag in one index: one insert extends both trees, but a search in one tree must skip nearer vertices of the
    /// other
    Tags,
}

impl Layout {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Layout::Indices => "indices",
            Layout::Tags => "tags",
        }
    }
}

/// The trees of one problem on one server.
#[derive(Clone, Debug)]
pub struct Store {
    layout: Layout,
    /// The index of the tree from the start, and of the tree from the goal; with tags, both are the same index.
    trees: [IndexHandle; 2],
    meeting: Meeting,
}

impl Store {
    /// Creates the store under a unique name, with the roots of both trees.
    pub async fn create(
        client: &Client,
        name: &str,
        layout: Layout,
        problem: &impl Problem,
    ) -> Result<Store, PlanningError> {
        let space: &Space = problem.space();
        for name in names(name, layout) {
            client.create_index(&name, space).await?;
        }
        Meeting::create(client, name, space).await?;
        let store = Store::open(client, name, layout).await?;
        let roots = [problem.start(), problem.goal()];
        for (tree, root) in roots.into_iter().enumerate() {
            let insert = store.trees[tree].insert([root]).ids([ROOTS[tree]]);
            insert.tags([vertex::tag(tree, 0)]).await?;
        }
        Ok(store)
    }

    /// Opens the store of this name.
    pub async fn open(client: &Client, name: &str, layout: Layout) -> Result<Store, PlanningError> {
        let [start, goal] = names(name, layout);
        Ok(Store {
            layout,
            trees: [client.index(&start).await?, client.index(&goal).await?],
            meeting: Meeting::open(client, name).await?,
        })
    }

    /// Deletes the store.
    pub async fn delete(&self, client: &Client) {
        let trees = self.trees.iter().map(IndexHandle::name);
        for name in trees.chain([self.meeting.name()]) {
            // A deletion fails if the server is gone, and its indices with it, or the second time if both trees share
            // one index.
            let _ = client.delete_index(name).await;
        }
    }

    /// The distinction between the trees.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// The index that holds a tree.
    pub fn index(&self, tree: usize) -> &IndexHandle {
        &self.trees[tree]
    }

    /// The meeting of the trees.
    pub fn meeting(&self) -> &Meeting {
        &self.meeting
    }

    /// The filter for the points of a tree in its index.
    pub fn filter(&self, tree: usize) -> Filter {
        match self.layout {
            Layout::Indices => Filter::default(),
            Layout::Tags => vertex::of_tree(tree),
        }
    }

    /// The trees of each index.
    pub fn together(&self) -> &'static [&'static [usize]] {
        match self.layout {
            Layout::Indices => &[&[0], &[1]],
            Layout::Tags => &[&[0, 1]],
        }
    }
}

fn names(name: &str, layout: Layout) -> [String; 2] {
    match layout {
        Layout::Indices => [format!("{name}-start"), format!("{name}-goal")],
        Layout::Tags => [name.to_owned(), name.to_owned()],
    }
}
