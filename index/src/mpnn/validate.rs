//! The invariants of the tree, for the tests.

use super::{Mpnn, Node, SIDE_TOLERANCE, enclosing_box};

impl Mpnn {
    /// Checks that each split is the sliding midpoint of its cell, that leaves hold each point once, within its cell,
    /// and that no leaf is larger than it has to be.
    ///
    /// # Errors
    /// The first invariant found broken.
    pub fn validate(&self) -> Result<(), String> {
        let mut next_node = 0;
        let mut open = Vec::new();
        if !self.is_empty() {
            open.push((0, 0..self.len() as u32, self.lo.clone(), self.hi.clone()));
        }
        while let Some((index, rows, lo, hi)) = open.pop() {
            if index != next_node {
                return Err(format!("node {index} stands where {next_node} belongs"));
            }
            next_node += 1;
            let slots: Vec<u32> = rows.clone().collect();
            let (least, greatest) = enclosing_box(&self.points, &slots);
            let is_outside = |axis: usize| least[axis] < lo[axis] || greatest[axis] > hi[axis];
            if let Some(axis) = (0..lo.len()).find(|&axis| is_outside(axis)) {
                return Err(format!("node {index} leaves its cell in axis {axis}"));
            }
            let unit_length = |axis: usize| self.axes[axis].unit_length;
            let can_split =
                |axis: &usize| unit_length(*axis) > 0.0 && least[*axis] < greatest[*axis];
            let mut separable = (0..lo.len()).filter(can_split);
            match self.nodes.get(index) {
                Some(&Node::Split { axis, high, cut }) => {
                    let (axis, high) = (axis as usize, high as usize);
                    let side = |axis: usize| unit_length(axis) * (hi[axis] - lo[axis]);
                    let spread = |axis: usize| unit_length(axis) * (greatest[axis] - least[axis]);
                    let longest = separable.clone().map(side).fold(0.0, f64::max);
                    let is_long = |axis: usize| side(axis) >= longest * (1.0 - SIDE_TOLERANCE);
                    let is_wider = |other| is_long(other) && spread(other) > spread(axis);
                    if !is_long(axis) || separable.any(is_wider) {
                        return Err(format!(
                            "node {index} has a longer or wider side than {axis}"
                        ));
                    }
                    let middle = f64::midpoint(lo[axis], hi[axis]);
                    if cut != middle.max(least[axis]).min(greatest[axis]) {
                        return Err(format!("node {index} is cut at {cut}, not at {middle}"));
                    }
                    let first_high = self.nodes.iter().skip(high).find_map(|node| match node {
                        Node::Leaf { start, .. } => Some(*start),
                        Node::Split { .. } => None,
                    });
                    let inner = rows.start + 1..rows.end;
                    let Some(first_high) = first_high.filter(|first| inner.contains(first)) else {
                        return Err(format!("node {index} has an empty child"));
                    };
                    let (mut high_lo, mut low_hi) = (lo.clone(), hi.clone());
                    (high_lo[axis], low_hi[axis]) = (cut, cut);
                    open.push((high, first_high..rows.end, high_lo, hi));
                    open.push((index + 1, rows.start..first_high, lo, low_hi));
                }
                Some(&Node::Leaf { start, end }) => {
                    if (start..end) != rows {
                        return Err(format!("leaf {index} holds {start}..{end}, not {rows:?}"));
                    }
                    if rows.len() > self.leaf_rows && separable.next().is_some() {
                        return Err(format!("leaf {index} holds {} points", rows.len()));
                    }
                }
                None => return Err(format!("there is no node {index}")),
            }
        }
        if next_node != self.nodes.len() {
            return Err(format!("{next_node} nodes of {}", self.nodes.len()));
        }
        Ok(())
    }
}
