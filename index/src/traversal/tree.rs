//! The interface of a tree to a search, and the frontier of nodes that remain to be visited.

use arrayvec::ArrayVec;

use super::Traversal;
use crate::{
    Points,
    lanes::{Isa, MAX_CHILDREN},
    scan_policy::ScanPolicy,
};

/// No tree is higher. A static tree of as many points as slots can number, one in a leaf, has 8 levels of nodes, and a
/// growing tree is sealed before it gets there.
pub(crate) const MAX_HEIGHT: usize = 11;

/// A tree of a structure, as one search sees it. `'a` is the lifetime of its points.
pub(crate) trait Tree<'a> {
    /// A node or a leaf.
    type Cell: Copy;
    /// [`Tree::child`] finds a node's children by it.
    type Children: Copy;

    /// The newest revision of a state in the tree.
    fn newest(&self) -> u64;
    fn root(&self) -> Option<Self::Cell>;
    fn child(&self, children: Self::Children, child: usize) -> Self::Cell;
    /// Scans a leaf, or adds a node to the frontier.
    fn visit<I: Isa>(
        &mut self,
        cell: Self::Cell,
        traversal: &mut Traversal<'a>,
        frontier: &mut Frontier<Self::Children>,
    );
    /// Scans all points in memory order.
    fn scan<I: Isa>(&mut self, traversal: &mut Traversal<'a>);
    /// The policy that chooses between both; None for a tree too small for a choice.
    fn scan_policy(&self) -> Option<&'a ScanPolicy>;
    /// True if a scan would have cost less than a descent that visited `leaves` leaves.
    fn scan_is_cheaper(&self, leaves: usize) -> bool;
    /// Fetches what the search reads after the next cell.
    fn prefetch(&self, _: &Frontier<Self::Children>) {}
}

/// A node with children still to be visited.
pub(super) struct OpenNode<C> {
    pub(super) children: C,
    /// The keys of its children, and a bit for each child that remains.
    pub(super) keys: [f64; MAX_CHILDREN],
    pub(super) remaining: u32,
    /// The nearest remaining child.
    pub(super) nearest: usize,
}

/// The nodes between the root and the current cell that have children left.
pub(crate) struct Frontier<C>(pub(super) ArrayVec<OpenNode<C>, MAX_HEIGHT>);

impl<C: Copy> Frontier<C> {
    /// The child to visit next, and its node's children, unless the current cell makes it too far away.
    #[inline(always)]
    pub(crate) fn peek(&self) -> Option<(C, usize)> {
        self.0.last().map(|open| (open.children, open.nearest))
    }
}

/// The id, tag and revision of each point, by its slot.
pub(crate) trait Labels {
    fn id(&self, slot: usize) -> u64;
    fn tag(&self, slot: usize) -> u64;
    fn revision(&self, slot: usize) -> u64;
}

impl Labels for Points {
    fn id(&self, slot: usize) -> u64 {
        self.id(slot)
    }

    fn tag(&self, slot: usize) -> u64 {
        self.tag(slot)
    }

    fn revision(&self, slot: usize) -> u64 {
        self.revision(slot)
    }
}
