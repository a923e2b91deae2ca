//! Options of `reveille tls`, which `commands/tls.rs` executes. Names of options are a public interface (see `cli`).

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::examples::examples;
use super::parse::whole;

/// Subcommands of `reveille tls`.
#[derive(Subcommand)]
pub(crate) enum TlsCommand {
    /// Make a certificate authority (CA), and a certificate and key for each role
    ///
    /// FOLDER gets a subfolder for each role, with the three files that a process of the role needs: bs for the base
    /// station, device, observer (`inspect`), operator (`clock`, `dashboard`), policy and router. No process needs the
    /// subfolder ca, which has the key of the CA.
    #[command(after_help = examples!(
        "reveille tls init certificates --name bs.example.org",
        "reveille tls init certificates --renew --days 30",
    ))]
    Init(TlsInitArgs),
    /// Print the certificates in a folder: names, issuer, serial number and validity
    ///
    /// Warnings name certificates that expire soon, and keys that other users may read.
    #[command(after_help = examples!("reveille tls show certificates", "reveille tls show /tls"))]
    Show {
        /// Folder of `reveille tls init`, or a folder with some of its subfolders.
        folder: PathBuf,
    },
}

/// Arguments of `reveille tls init`.
#[derive(Args)]
pub(crate) struct TlsInitArgs {
    /// Folder to write.
    pub folder: PathBuf,
    /// Host name or address at which clients reach the base station, in addition to localhost. May be repeated.
    #[arg(long, value_name = "HOST")]
    pub name: Vec<String>,
    /// Validity of the role certificates, days. The CA is valid for ten years.
    #[arg(
        long,
        value_name = "DAYS",
        default_value_t = 90,
        value_parser = whole(1..=3_650_u32),
        allow_negative_numbers = true
    )]
    pub days: u32,
    /// Renew the role certificates with the CA in the folder, if it has one. Certificates keep their names, and
    /// --name adds names.
    #[arg(long)]
    pub renew: bool,
}
