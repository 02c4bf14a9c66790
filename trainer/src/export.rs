//! From an operator over Hermite polynomials to the bytes that the controller reads.

use std::io::Write;
use std::path::{Path, PathBuf};

use firmware_core::Scalar;
use firmware_core::blob::{self, EmitError};
use firmware_core::capacity::{MAX_LAG, MAX_ORDER};
use firmware_core::dictionary::{Basis, Dictionary, block_size};
use firmware_core::model::{Model, ModelError, Space, Structure};

use crate::chain::Chain;
use crate::edmd::{Fit, Operator};
use crate::gram::hermite_powers;
use crate::terms::distinct_terms;

/// Why a model cannot be exported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The numbers do not fit the controller's f32, or the like.
    #[error("the controller would refuse the model: {0:?}")]
    Model(ModelError),
    /// The model does not predict its own training data.
    #[error(
        "the model diverges at a sample of its own training data: change the ridge or lower an order"
    )]
    SelfTest(EmitError),
}

/// Coefficients as the kernel takes them: shape `[outputs, dense_terms]`, powers of the observables
/// instead of Hermite polynomials, zeros for terms that are not distinct.
pub fn monomial_coefficients(dictionary: &Dictionary, operator: &Operator) -> Vec<f64> {
    const { assert!(MAX_ORDER < 16, "powers up to the order are exact in f64") };
    let (n, m) = (dictionary.dense_terms(), operator.outputs);
    let distinct = distinct_terms(dictionary);
    let mut coefficients = vec![0.0; m * n];
    for (output, row) in coefficients.chunks_exact_mut(n.max(1)).enumerate() {
        for (i, term) in distinct.iter().enumerate() {
            row[*term] = operator.matrix[i * m + output];
        }
        let mut first = 0;
        for (_, factors) in dictionary.blocks() {
            let size = block_size(factors);
            let block = &mut row[first..first + size];
            let mut after = size;
            for factor in factors {
                let radix = factor.radix();
                after /= radix;
                if factor.basis == Basis::Hermite {
                    to_powers(block, radix, after);
                }
            }
            first += size;
        }
    }
    coefficients
}

/// Converts one axis of a tensor, whose elements are `after` apart, from Hermite to powers.
fn to_powers(block: &mut [f64], radix: usize, after: usize) {
    let powers: Vec<Vec<f64>> = (0..radix).map(hermite_powers).collect();
    for slab in block.chunks_exact_mut(radix * after) {
        for offset in 0..after {
            let hermite: Vec<f64> = (0..radix).map(|i| slab[i * after + offset]).collect();
            for j in 0..radix {
                // Hⁱ holds vʲ for i = j, j + 2, …
                slab[j * after + offset] =
                    (j..radix).step_by(2).map(|i| powers[i][j] * hermite[i]).sum();
            }
        }
    }
}

/// The coefficients of a model: of a dense one, or of the terms of a chain.
pub fn coefficients(
    dictionary: &Dictionary,
    chain: Option<&Chain>,
    operator: &Operator,
) -> Vec<f64> {
    match chain {
        Some(chain) => chain.spread(&operator.matrix, operator.outputs),
        None => monomial_coefficients(dictionary, operator),
    }
}

/// The same in the f32 of the blob.
pub fn controller_coefficients(
    dictionary: &Dictionary,
    chain: Option<&Chain>,
    operator: &Operator,
) -> Vec<f32> {
    coefficients(dictionary, chain, operator).into_iter().map(|c| c as f32).collect()
}

/// The model of a structure with the coefficients of [`controller_coefficients`], or of
/// [`coefficients`] for a model in f64.
///
/// # Errors
/// [`ModelError`].
pub fn controller_model<'m, S: Scalar>(
    structure: Structure<'m>,
    chain: Option<&'m Chain>,
    coefficients: &'m [S],
    ranges: Option<&'m [S]>,
) -> Result<Model<'m, S>, ModelError> {
    match chain {
        Some(chain) => Model::new_sparse(structure, chain.entries(), coefficients, ranges),
        None => Model::new(structure, coefficients, ranges),
    }
}

/// The blob of a fit.
///
/// # Errors
/// [`ExportError`]: infinite coefficients, or a model that diverges on its own example.
pub fn export(fit: &Fit<'_>) -> Result<Vec<u8>, ExportError> {
    let structure = &fit.structure;
    let coefficients = controller_coefficients(structure.dictionary(), fit.chain, &fit.operator);
    let model = controller_model(structure.clone(), fit.chain, &coefficients, Some(&fit.ranges))
        .map_err(ExportError::Model)?;
    let (states, inputs) = &fit.example;
    let spaces: Vec<Space> = structure.states().iter().map(|s| s.space).collect();
    let states: Vec<f32> =
        states.iter().zip(spaces.iter().cycle()).map(|(x, space)| coordinate(*x, *space)).collect();
    let inputs: Vec<f32> = inputs.iter().map(|u| *u as f32).collect();
    // Another kernel or another sine may differ in the last bits; a wrong model differs by more.
    let tolerance: Vec<f32> = fit
        .spread
        .iter()
        .zip(&spaces)
        .zip(&states[states.len() - spaces.len()..])
        .map(|((spread, space), x)| match space {
            Space::Circle => 1e-4,
            Space::Line => (1e-4 * *spread as f32).max(1e-5 * x.abs()).max(f32::MIN_POSITIVE),
        })
        .collect();
    let numbers =
        coefficients.len() + fit.ranges.len() + (MAX_LAG + 3) * (states.len() + inputs.len());
    // Metadata: names and units, and a few bytes for every list entry.
    let names: usize =
        structure.states().iter().map(|s| s.name.len() + s.unit.len()).sum::<usize>()
            + structure.inputs().iter().map(|u| u.name.len() + u.unit.len()).sum::<usize>();
    let mut bytes = vec![
        0;
        4 * numbers
            + 2 * fit.chain.map_or(0, |c| c.entries().len())
            + names
            + structure.robot().len()
            + 4096
    ];
    let length = blob::emit(&model, &states, &inputs, &tolerance, &mut bytes)
        .map_err(ExportError::SelfTest)?;
    bytes.truncate(length);
    Ok(bytes)
}

/// A coordinate as the controller gets it: angles are wrapped before they lose digits to f32.
pub fn coordinate(x: f64, space: Space) -> f32 {
    match space {
        Space::Line => x as f32,
        Space::Circle => x.wrap() as f32,
    }
}

/// A file that could not be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: cannot be written: {source}", path.display())]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    /// Why.
    pub source: std::io::Error,
}

/// Writes a file whole or not at all: what `fill` writes goes to a temporary file beside `path`,
/// which takes its place only when everything is there.
///
/// # Errors
/// [`WriteError`]; `path` is then as it was before.
pub fn write_whole(
    path: &Path,
    fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), WriteError> {
    let attempt = || -> std::io::Result<()> {
        // A device or a pipe is never replaced by a file; what comes out of it cannot be whole.
        if std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
            let mut buffered =
                std::io::BufWriter::new(std::fs::OpenOptions::new().write(true).open(path)?);
            fill(&mut buffered)?;
            return buffered.flush();
        }
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        if !folder.is_dir() {
            return Err(std::io::Error::other("there is no such folder"));
        }
        let mut builder = tempfile::Builder::new();
        builder.prefix(".trainer-");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            // As any new file: the process's umask takes away what it takes away.
            builder.permissions(std::fs::Permissions::from_mode(0o666));
        }
        let mut file = builder.tempfile_in(folder)?;
        let mut buffered = std::io::BufWriter::new(file.as_file_mut());
        fill(&mut buffered)?;
        buffered.flush()?;
        drop(buffered);
        file.persist(path).map_err(|error| error.error)?;
        Ok(())
    };
    attempt().map_err(|source| WriteError { path: path.to_owned(), source })
}
