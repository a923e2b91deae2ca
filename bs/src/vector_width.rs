//! The choice of vector instructions at run time. It changes the time of a computation, never its result, since the
//! digests of runs depend on the results. Code must be inlined into [`VectorWidth::run`] to be compiled for the
//! instructions, so the modules that use it mark their functions for inlining.

#[cfg(target_arch = "x86_64")]
use pulp::x86::{V3, V4};
use pulp::{NullaryFnOnce, Scalar, Simd as _};

/// Set of vector instructions.
#[derive(Clone, Copy, Debug)]
pub enum VectorWidth {
    /// Baseline instructions of the architecture.
    Baseline(Scalar),
    /// x86-64-v3: eight numbers per instruction.
    #[cfg(target_arch = "x86_64")]
    V3(V3),
    /// x86-64-v4: sixteen numbers per instruction.
    #[cfg(target_arch = "x86_64")]
    V4(V4),
}

impl VectorWidth {
    /// Returns the sets that this CPU supports.
    pub fn supported() -> Vec<Self> {
        let mut supported = vec![Self::Baseline(Scalar)];
        #[cfg(target_arch = "x86_64")]
        {
            supported.extend(V3::try_new().map(Self::V3));
            supported.extend(V4::try_new().map(Self::V4));
        }
        supported
    }

    /// Returns the set that is used, never v4. On some CPUs v4 makes `dt` with attention a few hundredths faster; where
    /// it lowers the clock, `dt` takes half as long again.
    pub fn fastest() -> Self {
        #[cfg(target_arch = "x86_64")]
        if let Some(v3) = V3::try_new() {
            return Self::V3(v3);
        }
        Self::Baseline(Scalar)
    }

    /// Returns the result of `work`, which is compiled for these instructions where it is inlined. A large closure is
    /// not inlined; a type whose `call` is `#[inline(always)]` is.
    #[inline(always)]
    pub fn run<W: NullaryFnOnce>(self, work: W) -> W::Output {
        match self {
            Self::Baseline(scalar) => scalar.vectorize(work),
            #[cfg(target_arch = "x86_64")]
            Self::V3(v3) => v3.vectorize(work),
            #[cfg(target_arch = "x86_64")]
            Self::V4(v4) => v4.vectorize(work),
        }
    }
}
