//! `reveille tls`: certificates for mutual TLS. Each role has a folder with the files in [`TlsFiles`]; the folder `ca`
//! has the certificate and the key of the CA. The key of the CA signs all certificates, so its holder can take any
//! role.

use std::fmt::Write as _;
use std::fs::{self, DirBuilder, OpenOptions, Permissions};
use std::io::Write as _;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, SystemTime};

use anyhow::{Context, ensure};
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};
use reveille_common::bus::{Role, TlsFiles};
use x509_parser::certificate::Validity;

use crate::certificate::Certificate;
use crate::cli::{TlsCommand, TlsInitArgs};
use crate::display::{self, note};
use crate::exit::ExitReason;

/// The folder of the CA.
const CA: &str = "ca";
/// Validity of the CA.
const CA_DAYS: u32 = 3_650;
const DAY: Duration = Duration::from_hours(24);
/// Certificates are valid from so long before their making, because clocks of machines differ.
const BACKDATE: Duration = Duration::from_hours(1);
/// The common name of the CA.
const CA_NAME: &str = "Reveille CA";

/// Runs `reveille tls`.
pub(crate) fn run(command: &TlsCommand) -> anyhow::Result<ExitCode> {
    match command {
        TlsCommand::Init(args) => init(args)?,
        TlsCommand::Show { folder } => show(folder)?,
    }
    Ok(ExitReason::Done.into())
}

/// Makes the certificates of all roles, and first a CA if the folder has no CA.
fn init(args: &TlsInitArgs) -> anyhow::Result<()> {
    let ca = TlsFiles::new(&args.folder.join(CA));
    ensure!(
        args.renew || !ca.key.exists(),
        "{}: file exists; use --renew to renew the certificates, or another folder for a new CA",
        ca.key.display()
    );
    let has_role = |role: &Role| TlsFiles::new(&args.folder.join(role.name())).certificate.exists();
    ensure!(
        ca.key.exists() || !Role::ALL.iter().any(has_role),
        "{}: file is missing, so nothing here can be renewed; renew the certificates where this file is, and copy the \
         folders of the roles again",
        ca.key.display()
    );
    for name in &args.name {
        check_host_name(name)?;
    }
    // The permissions of an existing folder stay, which can hold other files.
    if !args.folder.is_dir() {
        make_folder(&args.folder)?;
    }
    if !ca.key.exists() {
        make_ca(&ca, &args.folder.join(CA))?;
    }
    Certificate::read(&ca.certificate)?
        .check_validity(&ca.certificate)
        .context("the CA cannot sign; make a new one in another folder")?;
    let ca_pem = fs::read_to_string(&ca.certificate).with_context(|| ca.certificate.display().to_string())?;
    let ca_key = fs::read_to_string(&ca.key).with_context(|| ca.key.display().to_string())?;
    let issuer = Issuer::from_ca_cert_pem(&ca_pem, KeyPair::from_pem(&ca_key)?)
        .with_context(|| format!("{}: not a CA", ca.certificate.display()))?;
    for role in Role::ALL {
        let folder = args.folder.join(role.name());
        let files = TlsFiles::new(&folder);
        let mut params = role_params(role, host_names(&args.name, &files))?;
        set_validity(&mut params, args.days);
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &issuer)?;
        make_folder(&folder)?;
        write_file(&files.ca, &ca_pem, 0o644)?;
        write_file(&files.key, &key.serialize_pem(), 0o600)?;
        write_file(&files.certificate, &certificate.pem(), 0o644)?;
    }
    show(&args.folder)
}

/// Makes a CA in `folder`, with the paths `files`.
fn make_ca(files: &TlsFiles, folder: &Path) -> anyhow::Result<()> {
    let mut params = CertificateParams::default();
    params.distinguished_name.push(DnType::CommonName, CA_NAME);
    // It signs certificates of roles, but no other CA.
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    set_validity(&mut params, CA_DAYS);
    let key = KeyPair::generate()?;
    let certificate = params.self_signed(&key)?;
    make_folder(folder)?;
    write_file(&files.certificate, &certificate.pem(), 0o644)?;
    // Written last: with the key, the CA counts as made.
    write_file(&files.key, &key.serialize_pem(), 0o600)
}

/// Returns the content of the certificate of `role`. Only the base station and routers can listen, under `host_names`.
fn role_params(role: Role, host_names: Vec<String>) -> anyhow::Result<CertificateParams> {
    const LISTENS: ExtendedKeyUsagePurpose = ExtendedKeyUsagePurpose::ServerAuth;
    const CONNECTS: ExtendedKeyUsagePurpose = ExtendedKeyUsagePurpose::ClientAuth;
    let (names, usages) = match role {
        Role::Bs => (host_names, vec![LISTENS]),
        Role::Router => (host_names, vec![LISTENS, CONNECTS]),
        Role::Device | Role::Observer | Role::Operator | Role::Policy => (Vec::new(), vec![CONNECTS]),
    };
    let mut params = CertificateParams::new(names)?;
    params.distinguished_name.remove(DnType::CommonName);
    params.distinguished_name.push(DnType::CommonName, role.name());
    params.use_authority_key_identifier_extension = true;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = usages;
    Ok(params)
}

/// Returns the host names for a base station or router: the names of its present certificate in `files`, or else of
/// this machine, and the names that are `given`.
fn host_names(given: &[String], files: &TlsFiles) -> Vec<String> {
    let local = || {
        let addresses = [IpAddr::from(Ipv4Addr::LOCALHOST), IpAddr::from(Ipv6Addr::LOCALHOST)];
        let addresses = addresses.map(|address| address.to_string());
        ["localhost".to_owned()].into_iter().chain(addresses).collect()
    };
    let mut names = Certificate::read(&files.certificate).map_or_else(|_| local(), |present| present.host_names);
    for name in given {
        if !names.contains(name) {
            names.push(name.clone());
        }
    }
    names
}

/// Refuses a name that no endpoint can have.
fn check_host_name(name: &str) -> anyhow::Result<()> {
    let is_dns_name = !name.is_empty() && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b));
    ensure!(
        is_dns_name || name.parse::<IpAddr>().is_ok(),
        "--name {name}: must be a host name or an address, without a port"
    );
    Ok(())
}

/// Makes `params` valid for `days` days from now.
#[expect(clippy::disallowed_methods, reason = "certificates are valid by the time of day")]
fn set_validity(params: &mut CertificateParams, days: u32) {
    let now = SystemTime::now();
    params.not_before = (now - BACKDATE).into();
    params.not_after = (now + DAY * days).into();
}

/// Creates a folder that only its owner can open, or restricts an existing one.
fn make_folder(folder: &Path) -> anyhow::Result<()> {
    let place = || folder.display().to_string();
    if folder.is_dir() {
        return fs::set_permissions(folder, Permissions::from_mode(0o700)).with_context(place);
    }
    DirBuilder::new().mode(0o700).create(folder).with_context(place)
}

/// Writes a file as a whole, with permissions `mode`: a process that starts meanwhile reads the former content or the
/// new one.
fn write_file(path: &Path, text: &str, mode: u32) -> anyhow::Result<()> {
    let place = || path.display().to_string();
    let draft = path.with_added_extension("draft");
    // A draft of a process that was killed keeps its permissions, so it is not written again.
    if draft.exists() {
        fs::remove_file(&draft).with_context(place)?;
    }
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(mode)
        .open(&draft)
        .with_context(place)?;
    file.write_all(text.as_bytes())
        .and_then(|()| fs::rename(&draft, path))
        .with_context(place)
}

/// Prints the certificates in `folder`, and warnings about them.
fn show(folder: &Path) -> anyhow::Result<()> {
    let mut text = String::new();
    for name in std::iter::once(CA).chain(Role::ALL.map(Role::name)) {
        let files = TlsFiles::new(&folder.join(name));
        if !files.certificate.exists() {
            continue;
        }
        let certificate = Certificate::read(&files.certificate)?;
        let hosts = certificate.host_names.join(", ");
        let issuer = &certificate.issuer;
        let Validity { not_before, not_after } = certificate.validity;
        let _infallible = writeln!(text, "{name}\n  name    {}", certificate.name);
        if !hosts.is_empty() {
            let _infallible = writeln!(text, "  hosts   {hosts}");
        }
        let _infallible = writeln!(
            text,
            "  issuer  {issuer}\n  serial  {}\n  valid   {not_before} to {not_after}",
            certificate.serial
        );
        if let Err(error) = certificate.check_validity(&files.certificate) {
            note!("warning: {error:#}");
        }
        for path in [folder.join(name), files.key] {
            let mode = fs::metadata(&path).map_or(0, |metadata| metadata.permissions().mode() & 0o777);
            if mode & 0o077 != 0 {
                note!(
                    "warning: {}: open to other users (mode {mode:o}); restrict it with `chmod go= {0}`",
                    path.display()
                );
            }
        }
    }
    ensure!(
        !text.is_empty(),
        "{}: no certificates; make them with `reveille tls init`",
        folder.display()
    );
    display::print_stdout(&text)
}
