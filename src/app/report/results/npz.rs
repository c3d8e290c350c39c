//! Arrays of a `.npz` file, read as streams of numbers.
//!
//! Memory grows with the data that a file holds, not with what its headers claim.

use std::fmt::Display;
use std::fs::File;
use std::io::{self, BufReader, Read, Write};
use std::path::Path;

use anyhow::{Context as _, Result, anyhow, ensure};
use bytemuck::Pod;
use npyz::{AutoSerialize, DType, Deserialize, NpyFile, Order, TypeChar, WriterBuilder};
use zip::ZipArchive;
use zip::result::ZipError;

use crate::app::run::memory;
use crate::recording::scan_files::npy::read_header;

/// Size of the buffer between decompression and numbers [bytes].
const BUFFER_BYTES: usize = 1 << 16;

/// Arrays that are not kept in memory: a row of them counts.
const READ_BY_ROWS: [&str; 2] = ["particles", "scan_outlines"];

/// Largest magnitude of a number of a result: beyond any position, covariance, time and frame, and
/// exact as an integer.
const LARGEST: f64 = 1e15;

/// A `.npz` file that is open for reading.
pub struct NpzReader<'a> {
    path: &'a Path,
    archive: ZipArchive<BufReader<File>>,
}

impl<'a> NpzReader<'a> {
    /// Opens a file.
    pub fn open(path: &'a Path) -> Result<Self> {
        let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
        let archive = ZipArchive::new(BufReader::new(file)).map_err(|error| match error {
            ZipError::Io(error) => anyhow!("cannot read {}: {error}", path.display()),
            error => not_npz(path, &error),
        })?;
        Ok(Self { path, archive })
    }

    /// Opens an array; `None` if the file has none of this name.
    pub fn array(&mut self, name: &'static str) -> Result<Option<Array<'_>>> {
        let entry = match self.archive.by_name(&format!("{name}.npy")) {
            Ok(entry) => entry,
            Err(ZipError::FileNotFound) => return Ok(None),
            Err(error) => return Err(not_npz(self.path, &error)),
        };
        let bytes = entry.size();
        let entry = BufReader::with_capacity(BUFFER_BYTES, entry).take(bytes);
        let (shape, numbers) = open_array(entry, READ_BY_ROWS.contains(&name))
            .map_err(|e| bad_array(self.path, name, &e))?;
        Ok(Some(Array {
            path: self.path,
            name,
            shape,
            numbers,
        }))
    }

    /// Opens an array that must be there.
    pub fn required(&mut self, name: &'static str) -> Result<Array<'_>> {
        let path = self.path;
        self.array(name)?.with_context(|| {
            format!(
                "{} has no array `{name}`; it needs `particles` and `start_idx`, as localize and range-mcl write them",
                path.display()
            )
        })
    }
}

fn not_npz(path: &Path, error: &ZipError) -> anyhow::Error {
    anyhow!(
        "{} is not a result file (.npz) or is cut off: {error}; run localize again",
        path.display()
    )
}

fn bad_array(path: &Path, name: &str, error: &impl Display) -> anyhow::Error {
    anyhow!("{}, array `{name}`: {error}", path.display())
}

/// Numbers of any type in row-major order, converted to `f64`.
type Numbers<'a> = Box<dyn Iterator<Item = io::Result<f64>> + 'a>;

/// An array whose numbers are still to be read.
pub struct Array<'a> {
    path: &'a Path,
    name: &'static str,
    /// Extent of each axis; empty for a scalar.
    pub shape: Vec<usize>,
    numbers: Numbers<'a>,
}

impl Array<'_> {
    /// Checks the shape against a pattern, in which `None` is any extent.
    pub fn expect_shape(&self, pattern: &[Option<usize>], expected: &'static str) -> Result<()> {
        let is_expected = self.shape.len() == pattern.len()
            && (self.shape.iter().zip(pattern))
                .all(|(&found, expected)| expected.is_none_or(|expected| expected == found));
        let error = format!("its shape is {:?}, but {expected} is needed", self.shape);
        ensure!(is_expected, bad_array(self.path, self.name, &error));
        Ok(())
    }

    /// Reads the next `N` numbers; integers beyond 2⁵³ are rounded.
    pub fn next_row<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut row = [0.0; N];
        for number in &mut row {
            let next = self.numbers.next();
            *number = next
                .unwrap_or_else(|| Err(io::ErrorKind::UnexpectedEof.into()))
                .map_err(|error| bad_array(self.path, self.name, &unreadable(&error)))?;
        }
        Ok(row)
    }

    /// As [`next_row`](Self::next_row), of finite numbers that a result can have; `row` is its index
    /// for the message.
    pub fn next_finite_row<const N: usize>(&mut self, row: usize) -> Result<[f64; N]> {
        let numbers = self.next_row()?;
        self.finite(row, numbers)
    }

    /// As [`next_finite_row`](Self::next_finite_row), but a row of NaN only, an unknown pose, is allowed, too.
    pub fn next_row_or_unknown<const N: usize>(&mut self, row: usize) -> Result<[f64; N]> {
        let numbers: [f64; N] = self.next_row()?;
        if numbers.iter().all(|number| number.is_nan()) {
            return Ok(numbers);
        }
        self.finite(row, numbers)
    }

    fn finite<const N: usize>(&self, row: usize, numbers: [f64; N]) -> Result<[f64; N]> {
        let is_invalid = |number: &&f64| !number.is_finite() || number.abs() > LARGEST;
        match numbers.iter().find(is_invalid) {
            Some(&value) => Err(not_valid(self.path, self.name, row, value)),
            None => Ok(numbers),
        }
    }
}

/// The error of a number that a result cannot have.
pub fn not_valid(path: &Path, name: &str, row: usize, value: f64) -> anyhow::Error {
    let path = path.display();
    anyhow!("{path}, array `{name}`, row {row}: {value} is not a valid value")
}

fn unreadable(error: &io::Error) -> String {
    format!("it cannot be read: {error}")
}

fn not_numbers(found: &DType) -> anyhow::Error {
    anyhow!(
        "its elements are of type {}, but numbers are needed (float32, float64, int16, int32, int64, uint8 or bool); convert it with numpy.asarray(array, float)",
        found.descr()
    )
}

/// Reads the header of an array and checks that the bytes after it are those that it claims.
fn open_array<'a>(
    mut entry: io::Take<impl Read + 'a>,
    is_read_by_rows: bool,
) -> Result<(Vec<usize>, Numbers<'a>)> {
    let header =
        read_header(&mut entry).map_err(|problem| anyhow!("it cannot be read: it {problem}"))?;
    let DType::Plain(element) = header.dtype() else {
        return Err(not_numbers(&header.dtype()));
    };
    ensure!(
        header.order() != Order::Fortran || header.shape().len() <= 1,
        "it is in Fortran order; save it with numpy.ascontiguousarray"
    );
    let shape = header.shape().to_vec();
    let bytes = u128::from(element.size_field());
    let needed = (shape.iter()).fold(bytes, |product, &extent| {
        product.saturating_mul(u128::from(extent))
    });
    let found = entry.limit();
    let file = NpyFile::with_header(header, entry);
    let numbers = match (element.type_char(), element.size_field()) {
        (TypeChar::Float, 4) => numbers::<f32>(file, f64::from),
        (TypeChar::Float, 8) => numbers::<f64>(file, |number| number),
        (TypeChar::Int, 2) => numbers::<i16>(file, f64::from),
        (TypeChar::Int, 4) => numbers::<i32>(file, f64::from),
        (TypeChar::Int, 8) => numbers::<i64>(file, |number| number as f64),
        (TypeChar::Uint, 1) => numbers::<u8>(file, f64::from),
        (TypeChar::Bool, 1) => numbers::<bool>(file, f64::from),
        _ => return Err(not_numbers(&file.dtype())),
    }?;
    ensure!(
        needed == u128::from(found),
        "its shape {shape:?} needs {needed} bytes of numbers, but there are {found}"
    );
    // Numbers of single precision and rows of poses take about as much as in the file.
    let rows = if is_read_by_rows {
        shape.first().copied().unwrap_or(1).max(1)
    } else {
        1
    };
    let kept = needed as f64 / rows as f64;
    memory::budget().require("the array", kept, "give a smaller file")?;
    let shape = shape.into_iter().map(|extent| extent as usize).collect();
    Ok((shape, numbers))
}

fn numbers<'a, T: Deserialize + 'a>(
    file: NpyFile<impl Read + 'a>,
    convert: impl Fn(T) -> f64 + 'a,
) -> Result<Numbers<'a>> {
    let elements =
        (file.data::<T>()).map_err(|error| anyhow!(unreadable(&io::Error::other(error))))?;
    Ok(Box::new(elements.map(move |element| element.map(&convert))))
}

/// Writes one array in NumPy's format, many numbers at a time: the results of a million frames are hundreds of megabytes,
/// written after a signal.
///
/// # Errors
/// The numbers are not as many as the shape has, or cannot be written.
pub fn write_npy<T: AutoSerialize + Pod>(
    writer: impl Write,
    shape: &[usize],
    numbers: impl IntoIterator<Item = T>,
) -> io::Result<()> {
    /// Numbers that are written at once.
    const CHUNK: usize = 1 << 16;
    let shape: Vec<u64> = shape.iter().map(|&extent| extent as u64).collect();
    let mut writer = npyz::WriteOptions::<T>::new()
        .default_dtype()
        .shape(&shape)
        .writer(writer)
        .write_header_only()?;
    let mut chunk: Vec<T> = Vec::with_capacity(CHUNK);
    let mut written = 0;
    let mut write = |chunk: &[T]| {
        written += chunk.len() as u64;
        writer.write_all(bytemuck::cast_slice(chunk))
    };
    // Internal iteration: `next` of flattened rows is slow.
    numbers.into_iter().try_for_each(|number| {
        if chunk.len() == CHUNK {
            write(&chunk)?;
            chunk.clear();
        }
        chunk.push(number);
        io::Result::Ok(())
    })?;
    write(&chunk)?;
    let expected: u64 = shape.iter().product();
    if written == expected {
        Ok(())
    } else {
        let problem = format!("{written} numbers for an array of {expected}");
        Err(io::Error::new(io::ErrorKind::InvalidData, problem))
    }
}
