"""Names that a function in C cannot have."""

from __future__ import annotations

import re

# Of C99 to C23, and of C++, which may include the file.
_KEYWORDS = """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept const const_cast
    consteval constexpr constinit continue co_await co_return co_yield decltype default delete do double dynamic_cast
    else enum explicit export extern false float for friend goto if inline int long main mutable namespace new noexcept
    not not_eq nullptr operator or or_eq private protected public register reinterpret_cast requires restrict return
    short signed sizeof static static_assert static_cast struct switch template this thread_local throw true try typedef
    typeid typename typeof typeof_unqual union unsigned using virtual void volatile wchar_t while xor xor_eq
"""
# Functions that compilers know without a header, of the standard library and of GNU C; those of numbers also end in f
# and l, and in the names of further types.
_OF_NUMBERS = """
    acos acosh asin asinh atan atan2 atanh cabs cacos cacosh carg casin casinh catan catanh cbrt ccos ccosh ceil cexp
    cimag clog clog10 conj copysign cos cosh cpow cproj creal csin csinh csqrt ctan ctanh drem erf erfc exp exp10 exp2
    expm1 fabs fdim finite floor fma fmax fmin fmod frexp gamma hypot ilogb isinf isnan j0 j1 jn ldexp lgamma llrint
    llround log log10 log1p log2 logb lrint lround modf nan nearbyint nextafter nexttoward pow pow10 remainder remquo
    rint round roundeven scalb scalbln scalbn signbit significand sin sincos sinh sqrt tan tanh tgamma trunc y0 y1 yn
"""
_FUNCTIONS = """
    abort abs aligned_alloc alloca bcmp bcopy bzero calloc dcgettext dgettext execl execle execlp execv execve execvp
    exit feclearexcept fegetenv fegetexceptflag fegetround feholdexcept feraiseexcept fesetenv fesetexceptflag
    fesetround fetestexcept feupdateenv ffs ffsimax ffsl ffsll fork fpclassify fprintf fputc fputs free fscanf fwrite
    gamma_r gammaf_r gammal_r gettext imaxabs index isascii isfinite isgreater isgreaterequal isless islessequal
    islessgreater isnormal isunordered labs lgamma_r lgammaf_r lgammal_r linux llabs malloc memchr memcmp memcpy memmove
    mempcpy memset posix_memalign printf putc putchar puts realloc rindex scanf signgam snprintf sprintf sscanf stpcpy
    stpncpy strcasecmp strcat strchr strcmp strcpy strcspn strdup strfmon strftime strlen strncasecmp strncat strncmp
    strncpy strndup strnlen strpbrk strrchr strspn strstr toascii tolower toupper towlower towupper unix vfprintf
    vfscanf vprintf vscanf vsnprintf vsprintf vsscanf
"""
_UNLOCKED = r"(fprintf|fputc|fputs|fwrite|printf|putc|putchar|puts)_unlocked"
_CLASSES = r"isw?(alnum|alpha|blank|cntrl|digit|graph|lower|print|punct|space|upper|xdigit)"
# Types and macros of stdint.h, math.h and what they include.
_DEFINED = (
    r"u?int\w*_t|float_t|double_t|U?INT\w*_(C|MAX|MIN)|[A-Z]+_(MAX|MIN)|FP_[A-Z]+|HUGE_VAL[FL]?|INFINITY|NAN|M_\w+"
)
_TAKEN = frozenset(f"{_KEYWORDS} {_FUNCTIONS}".split())
_NUMERIC = rf"({'|'.join(_OF_NUMBERS.split())})([fl]|f(16|32|64|128)x?|d(32|64|128))?"
_PATTERNS = f"{_NUMERIC}|{_UNLOCKED}|{_CLASSES}|{_DEFINED}"


def is_function_name(name: str) -> bool:
    """Return whether a policy's function may have this name: ASCII letters, digits, underscores, and not taken."""
    is_identifier = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is not None
    return is_identifier and name not in _TAKEN and re.fullmatch(_PATTERNS, name) is None
