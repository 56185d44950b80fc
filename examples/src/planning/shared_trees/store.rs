//! The shared store of the workers: the indices that hold the trees, and the meeting.

use wayfold::{Client, IndexHandle, PayloadEncoding};

use super::{
    super::{error::PlanningError, problem::Problem},
    meeting,
    vertex::ROOTS,
};

/// The names of the indices that hold the trees of this name.
pub fn names(trees: &str) -> [String; 2] {
    ["start", "goal"].map(|end| format!("{trees}-{end}"))
}

/// The trees of one problem on one server, for the process that starts the workers.
#[derive(Clone, Debug)]
pub struct Store {
    indices: [IndexHandle; 2],
    meeting: IndexHandle,
}

impl Store {
    /// Creates the store under a unique name, with the roots of both trees.
    pub async fn create(
        client: &Client,
        name: &str,
        problem: &impl Problem,
    ) -> Result<Store, PlanningError> {
        let space = problem.space();
        let create = async |name: String, root: &[f64], id: u64| {
            let encoding = PayloadEncoding::Edges;
            let index = client.create_index_with(&name, space, encoding).await?;
            index.insert([root]).ids([id]).await?;
            Ok::<_, PlanningError>(index)
        };
        let [start, goal] = names(name);
        Ok(Store {
            indices: [
                create(start, problem.start(), ROOTS[0]).await?,
                create(goal, problem.goal(), ROOTS[1]).await?,
            ],
            meeting: client.create_index(&meeting::name(name), space).await?,
        })
    }

    /// Deletes the store.
    pub async fn delete(&self, client: &Client) {
        for index in self.indices.iter().chain([&self.meeting]) {
            // If the server is gone, its indices are gone too.
            let _ = client.delete_index(index.name()).await;
        }
    }

    /// The index of the tree from the start, and of the tree from the goal.
    pub fn indices(&self) -> &[IndexHandle; 2] {
        &self.indices
    }

    /// The index that tells where the trees have met.
    pub fn meeting(&self) -> &IndexHandle {
        &self.meeting
    }
}
