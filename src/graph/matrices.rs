//! The sparse matrices that a gather reads.

/// Which of a level's two matrices a gather uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matrix {
    /// One row per voxel.
    Volume,
    /// One row per bird's-eye-view cell.
    Bev,
}

/// A 0/1 matrix in compressed sparse rows: row `r` holds the columns `col[ptr[r]..ptr[r + 1]]`, strictly ascending.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Csr<'a> {
    /// `rows + 1` offsets into `col`, starting at 0, never descending, ending at `col.len()`.
    pub ptr: &'a [u32],
    /// Flat pixel index `camera * H * W + v * W + u` of each entry.
    pub col: &'a [u32],
}

/// The matrices of one level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Level<'a> {
    /// Rows `(x * Y + y) * Z + z`.
    pub volume: Csr<'a>,
    /// Rows `x * Y + y`: the union of the rows of that column's voxels.
    pub bev: Csr<'a>,
}

impl<'a> Level<'a> {
    /// One of them.
    pub fn matrix(&self, matrix: Matrix) -> Csr<'a> {
        match matrix {
            Matrix::Volume => self.volume,
            Matrix::Bev => self.bev,
        }
    }
}
