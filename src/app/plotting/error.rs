//! Why there is no picture.

use std::path::{Path, PathBuf};

use plotters::backend::{BitMapBackend, DrawingBackend};
use plotters::drawing::DrawingAreaErrorKind;

/// What can go wrong on the way to a picture; each names its file.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum PlotError {
    #[error("cannot read {}: {source}", path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot write {}: {source}", path.display())]
    Write {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot give {} a palette: {source}", path.display())]
    Encode {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot draw {}: {source}", path.display())]
    Draw {
        path: PathBuf,
        source: Box<DrawError>,
    },
    #[error("there is nothing to draw in {}: {what}", path.display())]
    Nothing { path: PathBuf, what: &'static str },
    #[error("cannot draw {}: {found} {what} where {expected} belong", path.display())]
    WrongLength {
        path: PathBuf,
        what: &'static str,
        found: usize,
        expected: usize,
    },
}

/// What the drawing library says.
pub type DrawError = DrawingAreaErrorKind<<BitMapBackend<'static> as DrawingBackend>::ErrorType>;

impl PlotError {
    /// An error of the drawing library on the way to a file.
    pub(super) fn draw(path: &Path) -> impl FnOnce(DrawError) -> Self {
        let path = path.to_owned();
        |source| Self::Draw {
            path,
            source: Box::new(source),
        }
    }
}
