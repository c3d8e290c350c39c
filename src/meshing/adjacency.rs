//! Incidence of vertices and triangle corners. Corner 3 t + k is corner k of triangle t.

/// The corners at each vertex.
pub struct VertexCorners {
    starts: Vec<usize>,
    corners: Vec<u32>,
}

impl VertexCorners {
    /// The corners of all triangles over a number of vertices.
    pub fn new(triangles: &[[u32; 3]], vertices: usize) -> Self {
        let mut starts = vec![0_usize; vertices + 1];
        for vertex in triangles.iter().flatten() {
            starts[*vertex as usize + 1] += 1;
        }
        for index in 1..starts.len() {
            starts[index] += starts[index - 1];
        }
        let mut ends = starts.clone();
        let mut corners = vec![0; 3 * triangles.len()];
        for (corner, vertex) in (0..).zip(triangles.iter().flatten()) {
            let end = &mut ends[*vertex as usize];
            corners[*end] = corner;
            *end += 1;
        }
        Self { starts, corners }
    }

    /// The corners at a vertex, ascending.
    pub fn of(&self, vertex: usize) -> &[u32] {
        &self.corners[self.starts[vertex]..self.starts[vertex + 1]]
    }
}

/// The other two vertices of a corner's triangle, in its order.
pub fn opposite_edge(triangles: &[[u32; 3]], corner: u32) -> (u32, u32) {
    let [a, b, c] = triangles[corner as usize / 3];
    match corner % 3 {
        0 => (b, c),
        1 => (c, a),
        _ => (a, b),
    }
}

/// The first of the edges opposite to a vertex, if they do not form a closed ring.
pub fn chain_start(edges: &[(u32, u32)]) -> Option<(u32, u32)> {
    let is_start = |&(from, _): &(u32, u32)| edges.iter().all(|&(_, to)| to != from);
    edges.iter().copied().find(is_start)
}
