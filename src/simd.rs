//! Vector registers as lanes, and the instruction sets that provide them.
//!
//! The compiler vectorizes plain loops over arrays only where it recognizes them, which it does
//! not in the traversal of a single ray. A [`SimdTask`] is therefore written in lanes and compiled
//! once per instruction set; [`dispatch`] selects the best one of this CPU. Every operation is
//! rounded by itself, so that all instruction sets give the same bits.

use std::ops::{Add, Div, Index, Mul, Sub};

use bytemuck::Pod;
use glam::Vec4;

/// Lanes of the widest register.
pub(crate) const WIDE: usize = 16;
/// Lanes of an eight-wide register.
pub(crate) const WIDTH: usize = 8;

/// Numbers on which operations work element by element.
pub(crate) trait Lanes:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Mul<f32, Output = Self>
    + Div<Output = Self>
{
    type Array: Pod + Index<usize, Output = f32>;

    fn to_array(self) -> Self::Array;
    /// The smaller number of each lane; NaN if that of `other` is NaN.
    fn min(self, other: Self) -> Self;
    /// The larger number of each lane; NaN if that of `other` is NaN.
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    /// Bit mask of the lanes with `self <= other`, the first lane lowest.
    fn le(self, other: Self) -> u32;
    /// Bit mask of the lanes with `self < other`, the first lane lowest.
    fn lt(self, other: Self) -> u32;
}

/// An instruction set, as a proof that this CPU has it.
pub(crate) trait Simd: Copy {
    /// Lanes of one or two registers.
    type F32x8: Lanes<Array = [f32; WIDTH]>;
    /// Lanes of one to four registers.
    type F32x16: Lanes<Array = [f32; WIDE]>;

    fn splat(self, number: f32) -> Self::F32x8;
    /// Whole numbers as floats.
    fn whole(self, numbers: [u16; WIDTH]) -> Self::F32x8;
    fn load_wide(self, numbers: [f32; WIDE]) -> Self::F32x16;
    fn splat_wide(self, number: f32) -> Self::F32x16;
}

/// Work that is compiled for each instruction set. All that it calls must be `inline(always)`.
pub(crate) trait SimdTask {
    type Output;

    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Runs a task with the best instruction set of this CPU.
pub(crate) fn dispatch<T: SimdTask>(task: T) -> T::Output {
    #[cfg(target_arch = "x86_64")]
    {
        if let Some(avx512) = avx512::Avx512::detect() {
            return avx512.run(task);
        }
        if let Some(avx2) = avx2::Avx2::detect() {
            return avx2.run(task);
        }
    }
    task.run(Baseline)
}

impl Lanes for Vec4 {
    type Array = [f32; 4];

    #[inline(always)]
    fn to_array(self) -> [f32; 4] {
        Self::to_array(&self)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::min(self, other)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::max(self, other)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self::abs(self)
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        self.cmple(other).bitmask()
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        self.cmplt(other).bitmask()
    }
}

/// The instructions that every CPU of the target has.
#[derive(Clone, Copy)]
pub(crate) struct Baseline;

impl Simd for Baseline {
    type F32x8 = Pair<Vec4, WIDTH>;
    type F32x16 = Pair<Pair<Vec4, WIDTH>, WIDE>;

    #[inline(always)]
    fn splat(self, number: f32) -> Self::F32x8 {
        Pair(Vec4::splat(number), Vec4::splat(number))
    }
    #[inline(always)]
    fn whole(self, numbers: [u16; WIDTH]) -> Self::F32x8 {
        let [a, b] = bytemuck::cast(numbers.map(f32::from));
        Pair(Vec4::from_array(a), Vec4::from_array(b))
    }
    #[inline(always)]
    fn load_wide(self, numbers: [f32; WIDE]) -> Self::F32x16 {
        let [a, b, c, d] = bytemuck::cast::<_, [[f32; 4]; 4]>(numbers);
        let [a, b, c, d] = [a, b, c, d].map(Vec4::from_array);
        Pair(Pair(a, b), Pair(c, d))
    }
    #[inline(always)]
    fn splat_wide(self, number: f32) -> Self::F32x16 {
        Pair(self.splat(number), self.splat(number))
    }
}

/// `LANES` lanes in two registers.
#[derive(Clone, Copy)]
pub(crate) struct Pair<L, const LANES: usize>(L, L);

impl<L: Lanes, const LANES: usize> Pair<L, LANES> {
    #[inline(always)]
    fn zip(self, other: Self, operation: impl Fn(L, L) -> L) -> Self {
        Self(operation(self.0, other.0), operation(self.1, other.1))
    }
}

impl<L: Lanes, const LANES: usize> Add for Pair<L, LANES> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
}

impl<L: Lanes, const LANES: usize> Sub for Pair<L, LANES> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
}

impl<L: Lanes, const LANES: usize> Mul for Pair<L, LANES> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
}

impl<L: Lanes, const LANES: usize> Div for Pair<L, LANES> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
}

impl<L: Lanes, const LANES: usize> Mul<f32> for Pair<L, LANES> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: f32) -> Self {
        Self(self.0 * factor, self.1 * factor)
    }
}

impl<L: Lanes, const LANES: usize> Lanes for Pair<L, LANES> {
    type Array = [f32; LANES];

    #[inline(always)]
    fn to_array(self) -> [f32; LANES] {
        bytemuck::cast([self.0.to_array(), self.1.to_array()])
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, L::min)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, L::max)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.abs(), self.1.abs())
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        self.0.le(other.0) | self.1.le(other.1) << (LANES / 2)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        self.0.lt(other.0) | self.1.lt(other.1) << (LANES / 2)
    }
}

/// An operation of two registers that carry the proof of their instruction set.
#[cfg(target_arch = "x86_64")]
macro_rules! of_two {
    ($lanes:ident, $intrinsic:ident, $a:expr, $b:expr) => {
        // SAFETY: the lanes carry the proof that the CPU has the instruction.
        $lanes(unsafe { $intrinsic($a.0, $b.0) }, $a.1)
    };
}

/// Implements lanes in one register by the intrinsics of their operations.
#[cfg(target_arch = "x86_64")]
macro_rules! register {
    (
        $lanes:ident, $array:ty:
        Add $add:ident, Sub $sub:ident, Mul $mul:ident, Div $div:ident,
        min $min:ident, max $max:ident, splat $splat:expr, abs $abs:expr, le $le:expr, lt $lt:expr,
    ) => {
        register!($lanes, Add add $add, Sub sub $sub, Mul mul $mul, Div div $div);

        impl Mul<f32> for $lanes {
            type Output = Self;
            #[inline(always)]
            fn mul(self, factor: f32) -> Self {
                self * $splat(self.1, factor)
            }
        }

        impl Lanes for $lanes {
            type Array = $array;

            #[inline(always)]
            fn to_array(self) -> $array {
                bytemuck::cast(self.0)
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                of_two!($lanes, $min, self, other)
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                of_two!($lanes, $max, self, other)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                // SAFETY: `self` carries the proof that the CPU has the instruction.
                Self(unsafe { $abs(self.0) }, self.1)
            }
            #[inline(always)]
            fn le(self, other: Self) -> u32 {
                // SAFETY: `self` carries the proof that the CPU has the instruction.
                unsafe { $le(self.0, other.0) }
            }
            #[inline(always)]
            fn lt(self, other: Self) -> u32 {
                // SAFETY: `self` carries the proof that the CPU has the instruction.
                unsafe { $lt(self.0, other.0) }
            }
        }
    };
    ($lanes:ident, $($operator:ident $method:ident $intrinsic:ident),*) => {
        $(impl $operator for $lanes {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                of_two!($lanes, $intrinsic, self, other)
            }
        })*
    };
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2 {
    #![expect(unsafe_code, reason = "vector instructions exist only on some CPUs")]

    use std::arch::x86_64::*;
    use std::ops::{Add, Div, Mul, Sub};

    use crate::simd::{Lanes, Pair, Simd, SimdTask, WIDE, WIDTH};

    /// Proof that this CPU has AVX2: only [`Avx2::detect`] makes one.
    #[derive(Clone, Copy)]
    pub struct Avx2(());

    impl Avx2 {
        pub fn detect() -> Option<Self> {
            is_x86_feature_detected!("avx2").then_some(Self(()))
        }

        /// Runs a task compiled for AVX2.
        pub fn run<T: SimdTask>(self, task: T) -> T::Output {
            #[target_feature(enable = "avx2")]
            fn run_compiled<T: SimdTask>(task: T, avx2: Avx2) -> T::Output {
                task.run(avx2)
            }
            // SAFETY: `self` proves that the CPU has AVX2.
            unsafe { run_compiled(task, self) }
        }

        /// The proof that a CPU with AVX-512 has AVX2.
        pub fn of(_: crate::simd::avx512::Avx512) -> Self {
            Self(())
        }

        #[inline(always)]
        fn load(self, numbers: [f32; WIDTH]) -> F32x8 {
            F32x8(bytemuck::cast(numbers), self)
        }
    }

    impl Simd for Avx2 {
        type F32x8 = F32x8;
        type F32x16 = Pair<F32x8, WIDE>;

        #[inline(always)]
        fn splat(self, number: f32) -> F32x8 {
            self.load([number; WIDTH])
        }
        #[inline(always)]
        fn whole(self, numbers: [u16; WIDTH]) -> F32x8 {
            let numbers = bytemuck::cast(numbers);
            // SAFETY: `self` proves that the CPU has AVX2.
            let lanes = unsafe { _mm256_cvtepi32_ps(_mm256_cvtepu16_epi32(numbers)) };
            F32x8(lanes, self)
        }
        #[inline(always)]
        fn load_wide(self, numbers: [f32; WIDE]) -> Pair<F32x8, WIDE> {
            let [low, high] = bytemuck::cast(numbers);
            Pair(self.load(low), self.load(high))
        }
        #[inline(always)]
        fn splat_wide(self, number: f32) -> Pair<F32x8, WIDE> {
            Pair(self.splat(number), self.splat(number))
        }
    }

    /// Eight lanes in one register, with the proof that there is such a register.
    #[derive(Clone, Copy)]
    pub struct F32x8(__m256, Avx2);

    #[target_feature(enable = "avx2")]
    #[inline]
    fn abs(a: __m256) -> __m256 {
        _mm256_andnot_ps(_mm256_set1_ps(-0.0), a)
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn le(a: __m256, b: __m256) -> u32 {
        _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(a, b)) as u32
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn lt(a: __m256, b: __m256) -> u32 {
        _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(a, b)) as u32
    }

    register! { F32x8, [f32; WIDTH]:
        Add _mm256_add_ps, Sub _mm256_sub_ps, Mul _mm256_mul_ps, Div _mm256_div_ps,
        min _mm256_min_ps, max _mm256_max_ps,
        splat Avx2::splat, abs abs, le le, lt lt,
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512 {
    #![expect(unsafe_code, reason = "vector instructions exist only on some CPUs")]

    use std::arch::x86_64::*;
    use std::ops::{Add, Div, Mul, Sub};

    use crate::simd::avx2::{self, Avx2};
    use crate::simd::{Lanes, Simd, SimdTask, WIDE, WIDTH};

    /// Proof that this CPU has AVX2 and the first parts of AVX-512: only [`Avx512::detect`] makes one.
    #[derive(Clone, Copy)]
    pub struct Avx512(());

    impl Avx512 {
        pub fn detect() -> Option<Self> {
            let has_all = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl");
            has_all.then_some(Self(()))
        }

        /// Runs a task compiled for AVX-512.
        pub fn run<T: SimdTask>(self, task: T) -> T::Output {
            #[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl")]
            fn run_compiled<T: SimdTask>(task: T, avx512: Avx512) -> T::Output {
                task.run(avx512)
            }
            // SAFETY: `self` proves that the CPU has them.
            unsafe { run_compiled(task, self) }
        }
    }

    impl Simd for Avx512 {
        type F32x8 = avx2::F32x8;
        type F32x16 = F32x16;

        #[inline(always)]
        fn splat(self, number: f32) -> avx2::F32x8 {
            Avx2::of(self).splat(number)
        }
        #[inline(always)]
        fn whole(self, numbers: [u16; WIDTH]) -> avx2::F32x8 {
            Avx2::of(self).whole(numbers)
        }
        #[inline(always)]
        fn load_wide(self, numbers: [f32; WIDE]) -> F32x16 {
            F32x16(bytemuck::cast(numbers), self)
        }
        #[inline(always)]
        fn splat_wide(self, number: f32) -> F32x16 {
            self.load_wide([number; WIDE])
        }
    }

    /// Sixteen lanes in one register, with the proof that there is such a register.
    #[derive(Clone, Copy)]
    pub struct F32x16(__m512, Avx512);

    #[target_feature(enable = "avx512f")]
    #[inline]
    fn le(a: __m512, b: __m512) -> u32 {
        u32::from(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(a, b))
    }

    #[target_feature(enable = "avx512f")]
    #[inline]
    fn lt(a: __m512, b: __m512) -> u32 {
        u32::from(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b))
    }

    register! { F32x16, [f32; WIDE]:
        Add _mm512_add_ps, Sub _mm512_sub_ps, Mul _mm512_mul_ps, Div _mm512_div_ps,
        min _mm512_min_ps, max _mm512_max_ps,
        splat Avx512::splat_wide, abs _mm512_abs_ps, le le, lt lt,
    }
}
