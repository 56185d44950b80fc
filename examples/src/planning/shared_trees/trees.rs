//! Both complete trees, read from the server.

use wayfold::{Include, IndexHandle, States};

use super::{
    super::{error::PlanningError, rrt::Tree},
    store::Store,
    vertex::{self, ROOTS},
};

/// Both trees. Nodes are in the order of their revisions, and parents before their children.
pub struct SharedTrees {
    /// The tree from the start, and the tree from the goal.
    pub trees: [Tree; 2],
    /// The worker that made each node.
    pub makers: [Vec<usize>; 2],
    /// The revision of its index that stored each node.
    pub revisions: [Vec<u64>; 2],
}

impl SharedTrees {
    /// Reads both, and fails unless they are trees: the parent of each vertex except the roots belongs to the same
    /// tree, and was inserted earlier or precedes the vertex in the same mutation.
    pub async fn read(store: &Store) -> Result<SharedTrees, PlanningError> {
        let coordinates = store.indices()[0].coordinates();
        let mut read = SharedTrees {
            trees: [Tree::new(coordinates), Tree::new(coordinates)],
            makers: [Vec::new(), Vec::new()],
            revisions: [Vec::new(), Vec::new()],
        };
        for (tree, index) in store.indices().iter().enumerate() {
            // Reads the workers' last revision: their reports are behind it.
            index.info().await?;
            read.add(tree, Vertices::scan(tree, index).await?)?;
        }
        Ok(read)
    }

    /// Adds all vertices of a tree.
    fn add(&mut self, tree: usize, vertices: Vertices) -> Result<(), PlanningError> {
        let rows = &vertices.rows;
        // The rows of one mutation have ascending ids and belong to one worker.
        let mut order: Vec<usize> = (0..rows.len()).collect();
        order.sort_by_key(|&row| (rows[row].revision, rows[row].id));
        for row in order {
            let vertex = &rows[row];
            let own = &mut self.trees[tree];
            let parent = vertex.parent.map(|id| own.node(id));
            if parent == Some(None) {
                return Err(wrong(vertex.id, "its parent was not in its tree before it"));
            }
            own.push(parent.flatten(), vertices.states.row(row), vertex.id)?;
            self.makers[tree].push(vertex.worker);
            self.revisions[tree].push(vertex.revision);
        }
        Ok(())
    }

    /// The number of vertices of both trees.
    pub fn len(&self) -> usize {
        self.trees.iter().map(Tree::len).sum()
    }
}

/// The points of a tree's index.
struct Vertices {
    states: States,
    rows: Vec<Vertex>,
}

struct Vertex {
    id: u64,
    worker: usize,
    revision: u64,
    parent: Option<u64>,
}

impl Vertices {
    async fn scan(tree: usize, index: &IndexHandle) -> Result<Vertices, PlanningError> {
        let mut read = Vertices {
            states: States::new(index.coordinates()),
            rows: Vec::new(),
        };
        let mut scan = index.scan().include(Include::all()).await?;
        while let Some(part) = scan.next().await? {
            for point in part.iter() {
                let parent_id = point.payload.and_then(|payload| vertex::parent(payload));
                if parent_id.is_none() && point.id != ROOTS[tree] {
                    return Err(wrong(point.id, "its payload tells no parent"));
                }
                read.states.push(point.state)?;
                read.rows.push(Vertex {
                    id: point.id,
                    worker: point.tag as usize,
                    revision: point.revision,
                    parent: parent_id,
                });
            }
        }
        Ok(read)
    }
}

fn wrong(id: u64, problem: &'static str) -> PlanningError {
    PlanningError::Vertex { id, problem }
}
