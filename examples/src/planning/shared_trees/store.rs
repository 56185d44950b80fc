//! The shared store of the workers: the indices that hold the trees, and the meeting.

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use wayfold::{Client, IndexHandle, PayloadEncoding, Search};

use super::{
    super::{error::PlanningError, problem::Problem},
    meeting,
    vertex::{self, ROOTS},
};

/// The distinction between the two trees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
pub enum Layout {
    /// Each has an index of its own
    Indices,
    /// A tag in one index: a search in one tree must skip nearer vertices of the other
    Tags,
}

impl Layout {
    /// The names of the indices that hold the trees of this name.
    pub fn indices(self, trees: &str) -> Vec<String> {
        match self {
            Layout::Indices => vec![format!("{trees}-start"), format!("{trees}-goal")],
            Layout::Tags => vec![trees.to_owned()],
        }
    }

    /// The search for the nearest vertex of a tree in its index.
    pub fn nearest(self, tree: usize) -> Search {
        match self {
            Layout::Indices => Search::k(1),
            Layout::Tags => Search::k(1).tag(vertex::TREE, tree as u64),
        }
    }
}

/// The trees of one problem on one server, for the process that starts the workers.
#[derive(Clone, Debug)]
pub struct Store {
    indices: Vec<IndexHandle>,
    meeting: IndexHandle,
}

impl Store {
    /// Creates the store under a unique name, with the roots of both trees.
    pub async fn create(
        client: &Client,
        name: &str,
        layout: Layout,
        problem: &impl Problem,
    ) -> Result<Store, PlanningError> {
        let mut indices = Vec::new();
        for name in layout.indices(name) {
            indices.push(
                client
                    .create_index_with(&name, problem.space(), PayloadEncoding::Edges)
                    .await?,
            );
        }
        let name = meeting::name(name);
        let meeting = client.create_index(&name, problem.space()).await?;
        let store = Store { indices, meeting };
        let roots = [problem.start(), problem.goal()];
        for (tree, root) in roots.into_iter().enumerate() {
            let insert = store.index(tree).insert([root]).ids([ROOTS[tree]]);
            insert.tags([vertex::tag(tree, 0)]).await?;
        }
        Ok(store)
    }

    /// Deletes the store.
    pub async fn delete(&self, client: &Client) {
        for index in self.indices.iter().chain([&self.meeting]) {
            // If the server is gone, its indices are gone too.
            let _ = client.delete_index(index.name()).await;
        }
    }

    /// The indices, one for each tree or one for both.
    pub fn indices(&self) -> &[IndexHandle] {
        &self.indices
    }

    /// The index that holds a tree.
    pub fn index(&self, tree: usize) -> &IndexHandle {
        &self.indices[tree.min(self.indices.len() - 1)]
    }

    /// The index that tells where the trees have met.
    pub fn meeting(&self) -> &IndexHandle {
        &self.meeting
    }
}
