//! Rows of different lengths, of which only the last are in memory: the others are in an unnamed file.

use std::fmt;
use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::Pod;

use super::columns::Column;
use crate::shared_bytes::unnamed_file;

/// Rows that are appended and read by their index.
#[derive(Clone, Default)]
pub struct RowLog<T> {
    /// Folder of the file; by default that of temporary files.
    folder: Option<PathBuf>,
    /// Items before the last ones; a clone has the same, and appends none to it.
    file: Option<Arc<Mutex<File>>>,
    in_file: usize,
    /// The last items.
    last: Vec<T>,
    /// First index of the items of each row, and that after the last.
    rows: Column<[usize; 2]>,
}

impl<T: Pod> RowLog<T> {
    /// Largest size of the items in memory [bytes].
    const MOST_BYTES: usize = 1 << 22;

    /// An empty log whose file is in a folder, if it can be written there.
    pub fn in_folder(folder: &Path) -> Self {
        Self {
            folder: Some(folder.to_owned()),
            file: None,
            in_file: 0,
            last: Vec::new(),
            rows: Column::in_folder(folder),
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Number of items of a row.
    pub fn row_len(&self, row: usize) -> usize {
        let [start, end] = self.rows[row];
        end - start
    }

    /// A subset of the rows.
    #[must_use]
    pub fn select(&self, rows: &[usize]) -> Self {
        Self {
            folder: self.folder.clone(),
            file: self.file.clone(),
            in_file: self.in_file,
            last: self.last.clone(),
            rows: rows.iter().map(|&row| self.rows[row]).collect(),
        }
    }

    /// Appends a row.
    pub fn push(&mut self, items: &[T]) -> io::Result<()> {
        if size_of_val(&*self.last) + size_of_val(items) > Self::MOST_BYTES {
            self.spill()?;
        }
        let start = self.in_file + self.last.len();
        self.last.extend_from_slice(items);
        self.rows.push([start, start + items.len()]);
        Ok(())
    }

    /// Moves the items in memory to the file.
    fn spill(&mut self) -> io::Result<()> {
        if self.last.is_empty() {
            return Ok(());
        }
        let file = match &self.file {
            Some(file) => file,
            None => {
                let file = unnamed_file(self.folder.as_deref())?;
                self.file.insert(Arc::new(Mutex::new(file)))
            }
        };
        let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start((self.in_file * size_of::<T>()) as u64))?;
        file.write_all(bytemuck::cast_slice(&self.last))?;
        self.in_file += self.last.len();
        self.last.clear();
        Ok(())
    }

    /// The items of a row.
    pub fn row(&self, row: usize) -> io::Result<Vec<T>> {
        let [start, end] = self.rows[row];
        if let (Some(start), Some(end)) = (
            start.checked_sub(self.in_file),
            end.checked_sub(self.in_file),
        ) {
            return Ok(self.last[start..end].to_vec());
        }
        let mut items = vec![T::zeroed(); end - start];
        if let Some(file) = &self.file {
            let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start((start * size_of::<T>()) as u64))?;
            file.read_exact(bytemuck::cast_slice_mut(&mut items))?;
        }
        Ok(items)
    }
}

impl<T: Pod + fmt::Debug> fmt::Debug for RowLog<T> {
    /// The items, wherever they are.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = (0..self.len()).map(|row| self.row(row));
        formatter.debug_list().entries(rows).finish()
    }
}

impl<T: Pod + PartialEq> PartialEq for RowLog<T> {
    fn eq(&self, other: &Self) -> bool {
        let is_same = |row| matches!((self.row(row), other.row(row)), (Ok(a), Ok(b)) if a == b);
        self.len() == other.len() && (0..self.len()).all(is_same)
    }
}
