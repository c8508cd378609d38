/* Check a certificate by exact inequalities, a million actions within a minute.
 *
 *     cc -O2 -o check checker.c -lgmp -lz -lcrypto && ./check FILE
 *
 * It prints an interval that holds the optimum, and answers 0; or which inequality fails where, and
 * answers 1; or it cannot work, and answers 2. It shares nothing with the library, nor with
 * checker.py beside it, which reads the same files; docs/guides/certificate.md says more of them,
 * certificate_format.md what each key of a file means.
 *
 * The question. A run ends in the goal; or in a dead-end, from which no way leads to the goal; or
 * it is given up; or it wanders for ever. A quantity has weights >= 0 for expected costs, for
 * arrivals in states, for arrivals in ends, and for the two last cases ("stop"). An end of weight
 * -a < 0 counts as -a, and a for each other end. A row is quantity <= bound. With a discount the
 * share 1 - discount of each step comes to one more dead-end, which has the number n.
 *
 * Totals. A charge depends on what a run has paid of the first cost when it comes to the goal, and
 * is paid with the step into it. A node is a state with a total below the cap, which has a line of
 * the proof, or a state from the cap on. There numbers are lines, y + slope (total - cap), and so
 * are charges: the inequality at the cap, and that of the slopes, prove those at all totals. A
 * quantile is the claim if late runs, of a charge of 1, are few enough. A tail mean is the least
 * over thresholds z of z + max(total - z, 0) / (1 - level), and the best z is a total at the goal:
 * the cases of the proof hold all such z up to the last end, beyond which none does less than z.
 * Where policies must not be mixed, cases hold all decisions at a node, part by part.
 *
 * The proof. Each column of numbers y in the file bounds a quantity of its own from below:
 *
 *     y(x) <= own(x, u) + sum p(x') (arrival(x') + y(x')),  or y(x) <= own(x) + stop on stopping,
 *
 * so that none of those to whom its inequalities apply takes less than y at the start:
 *   v       the objective and, at prices >= 0, the rows, in each case. It is asked of all actions
 *           and stops; a lottery within the rows wanders by actions alone that take nothing of any
 *           quantity, as it would take infinitely much of one otherwise. Where no failure is
 *           allowed, it is asked of what keeps the goal sure;
 *   w       failure, if a share of the greatest goal probability is asked for;
 *   -t, -u  of a member of the lottery: minus its steps, which shows that it ends, and minus the
 *           objective and each row, which it takes at most u of. They are asked of its decisions;
 *   slopes  of v, and of a member's -u of the objective: how fast its charge grows. That of v is
 *           at most 0 where the goal can be avoided for ever: only there can totals go on growing.
 *
 * Numbers of the proof, arrivals and charges are rounded down to units, of 10^-60 or as said, a
 * step's own to units over the common denominator of its probabilities. All else is exact. The
 * model is read three times, a line at a time: for its graph, for the charges of dead-ends, and
 * for the inequalities; the proof once. Its SHA-256 ties the readings together.
 */
#include <ctype.h>
#include <gmp.h>
#include <openssl/evp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zlib.h>

enum { DIGITS = 60, LONGEST = 4000, DEEPEST = 900, NONE = -1, STOP = -2 };
enum { LINE = 1 << 24, ALL = 1 << 29, TIMES = 100 };  /* most bytes of a line; of all lines; of them
                                                      * per byte of the file, behind a line's */
enum { SHORTEST = 24 };  /* bytes of a line of a state, or of a node, at least */
enum { EXCESS = 24 };  /* digits of a bound, or of 1, behind which a lottery may exceed it, told */

static size_t n_lines;  /* that were read; 0 when all is read */

static _Noreturn void refuse(const char *format, ...) {
    va_list words;
    va_start(words, format);
    printf(n_lines ? "refused: line %zu: " : "refused: ", n_lines);
    gmp_vprintf(format, words);
    printf("\n");
    exit(1);
}

static _Noreturn void fail(const char *words) {
    fprintf(stderr, "%s\n", words);
    exit(2);
}

static void *zeros(size_t count, size_t size) {
    void *array = calloc(count + 1, size);
    if (!array) fail("there is not enough memory");
    return array;
}

/* Array with room for one more entry: its room is doubled when it is full. */
static void *grown(void *array, size_t count, size_t size) {
    if (count & (count - 1)) return array;
    array = realloc(array, (2 * count + 1) * size);
    if (!array) fail("there is not enough memory");
    return array;
}

/* ---- Rational numbers, which nobody changes once they are made ---- */

typedef mpq_srcptr rational;

static rational zero, one;
static size_t n_made, n_lasting;  /* numbers that are in use, those first of them for good */

/* Place for a number, which lasts until the next line is read. */
static mpq_ptr made(void) {
    static mpq_ptr *all;
    static size_t size;
    if (n_made == size) {
        all = grown(all, size, sizeof *all);
        mpq_init(all[size++] = zeros(1, sizeof(mpq_t)));
    }
    return all[n_made++];
}

static rational plus(rational a, rational b) {
    if (!mpq_sgn(a) || !mpq_sgn(b)) return mpq_sgn(a) ? a : b;
    mpq_ptr c = made();
    return mpq_add(c, a, b), c;
}

static rational minus(rational a, rational b) {
    mpq_ptr c = made();
    return mpq_sub(c, a, b), c;
}

static rational times(rational a, rational b) {
    if (!mpq_sgn(a) || !mpq_sgn(b)) return zero;
    mpq_ptr c = made();
    return mpq_mul(c, a, b), c;
}

static rational over(rational a, rational b) {
    mpq_ptr c = made();
    return mpq_div(c, a, b), c;
}

static rational of(mpz_srcptr whole) {
    mpq_ptr c = made();
    return mpq_set_z(c, whole), c;
}

static bool less(rational a, rational b) { return mpq_cmp(a, b) < 0; }

static rational *many_zeros(size_t count) {
    rational *array = zeros(count, sizeof *array);
    for (size_t i = 0; i < count; i++) array[i] = zero;
    return array;
}

/* A number times a whole one, rounded down. */
static void floor_of(mpz_t rounded, rational q, mpz_srcptr scale) {
    mpz_mul(rounded, mpq_numref(q), scale);
    mpz_fdiv_q(rounded, rounded, mpq_denref(q));
}

/* ---- Lines of JSON ---- */

struct json {
    char kind, *key, *text;      /* kind: its first letter, or 0 for each whole number */
    size_t number;
    struct json *first, *next;   /* of its entries; behind it in the same list or object */
    bool is_read;
};

static gzFile file;
static EVP_MD_CTX *hash;         /* of so many lines, of which the last one has no end */
static size_t n_hashed = 2;
static char *at;                 /* the part of the line that is not read yet */
static struct json *values;      /* of the line */
static size_t n_bytes, most_bytes;  /* that were unpacked since the file began */
static size_t n_values;

static bool take(char letter) {
    while (*at == ' ') at++;
    return *at == letter && at++;
}

static void expect(char letter) {
    if (!take(letter)) refuse("\"%.40s\" where %c should be", at, letter);
}

/* A string. Each has one way to be written, so that it may be compared as it is written. */
static char *quoted(void) {
    expect('"');
    char *text = at;
    for (; *at != '"'; at++) {
        if (!*at) refuse("a text does not end");
        if (*at != '\\' || (*++at && strchr("\"\\bfnrt", *at))) continue;
        bool four = *at == 'u' && strspn(at + 1, "0123456789abcdef") >= 4;
        if (!four || strncmp(at, "u007f", 5) < 0) refuse("a letter is escaped that is not to be");
    }
    *at++ = 0;
    return text;
}

static struct json *parsed(int depth) {
    struct json *value = &values[n_values++], **end = &value->first;
    while (*at == ' ') at++;
    *value = (struct json){.kind = *at};
    if (depth > DEEPEST) refuse("there are too many brackets");
    if (*at == '"') {
        value->text = quoted();
    } else if (*at == '[' || *at == '{') {
        for (at++; !take(value->kind == '[' ? ']' : '}'); end = &(*end)->next) {
            if (value->first) expect(',');
            char *key = value->kind == '{' ? quoted() : NULL;
            if (key) expect(':');
            *end = parsed(depth + 1);
            (*end)->key = key;
        }
    } else if (isdigit(*at)) {
        value->kind = '0';
        if (*at == '0' && isdigit(at[1])) refuse("\"%.20s\" is no whole number", at);
        value->number = strtoul(at, &at, 10);
    } else {
        const char *word = *at == 't' ? "true" : *at == 'f' ? "false" : "null";
        if (strncmp(at, word, strlen(word))) refuse("\"%.20s\" is no value", at);
        at += strlen(word);
    }
    return value;
}

/* The next line, or NULL where there is none and none need be. */
static struct json *next_line(bool needed) {
    static char *line;
    static size_t room, most_values;
    size_t length = 0, count = 1;
    int byte, error;
    n_lines++;
    while ((byte = gzgetc(file)) != -1) {
        if (length >= LINE) refuse("a line has more than %d bytes", LINE);
        if (++n_bytes > most_bytes) refuse("the lines have more than %zu bytes", most_bytes);
        if (byte == '\n') break;
        if (byte < ' ' || byte > '~') refuse("it is no printable ASCII");
        if (length + 1 >= room && !(line = realloc(line, room = 2 * room + 100)))
            fail("there is not enough memory");
        line[length++] = (char)byte;
        count += byte == ',' || byte == ':' || byte == '[';
    }
    if (byte == -1 && (gzerror(file, &error), error != Z_OK)) refuse("the gzip file is damaged");
    if (byte == -1 && !length && !needed) return NULL;
    if (!length) refuse(byte == -1 ? "the file ends too early" : "it is empty");
    line[length] = 0;
    if (n_lines <= n_hashed) EVP_DigestUpdate(hash, line, length);
    if (n_lines < n_hashed) EVP_DigestUpdate(hash, "\n", 1);
    if (count > most_values) {
        free(values);
        values = zeros(most_values = count, sizeof *values);
    }
    n_values = 0;
    n_made = n_lasting;
    at = line;
    struct json *value = parsed(0);
    if (take(' ') || *at) refuse("it goes on with \"%.40s\"", at);
    return value;
}

/* Refuse a line unless each of its values was read: keys that are not known, or come twice. */
static void end_line(void) {
    for (struct json *value = values; value < values + n_values; value++)
        if (!value->is_read) refuse("\"%s\" is not known", value->key ? value->key : "an entry");
}

static bool is(struct json *value, char kind) {
    return value && value->kind == kind && (value->is_read = true);
}

static bool says(struct json *value, const char *word) {
    return value && value->text && !strcmp(value->text, word) && is(value, '"');
}

static struct json *found(struct json *object, const char *key) {
    struct json *value = is(object, '{') ? object->first : NULL;
    while (value && strcmp(value->key, key)) value = value->next;
    return value;
}

static struct json *get(struct json *object, const char *key) {
    struct json *value = found(object, key);
    if (!value) refuse("there is no \"%s\"", key);
    return value;
}

static struct json *after(struct json *value) { return value ? value->next : NULL; }

/* A value, which is to be of one of these kinds. */
static struct json *typed(struct json *value, const char *kinds, const char *otherwise) {
    const char *key = value && value->key ? value->key : "an entry";
    const char *text = value && value->text ? value->text : "";
    if (!value || !strchr(kinds, value->kind)) refuse("%s \"%.40s\" is %s", key, text, otherwise);
    value->is_read = true;
    return value;
}

static struct json *list(struct json *value) { return typed(value, "[", "no list")->first; }

static char *string(struct json *value) { return typed(value, "\"", "no text")->text; }

static bool truth(struct json *value) {
    return typed(value, "tf", "neither true nor false")->kind == 't';
}

static size_t whole(struct json *value, size_t below) {
    size_t number = typed(value, "0", "no whole number")->number;
    if (number >= below) refuse("%zu is no whole number below %zu", number, below);
    return number;
}

static char *kept(const char *text) { return strcpy(zeros(strlen(text), 1), text); }

/* Digits at a place, of which there are some, are put behind others; what follows them. */
static const char *take_digits(const char *s, char *digits) {
    size_t size = strspn(s, "0123456789");
    if (!size) refuse("no number ends in \"%.40s\"", s);
    strncat(digits, s, size);
    return s + size;
}

/* A decimal or a fraction. */
static rational number(struct json *value) {
    static char digits[LONGEST], more[LONGEST];
    const char *s = string(value);
    long power = 0;
    mpq_ptr q = made();
    if (strlen(s) >= LONGEST) refuse("a number is too long");
    strcpy(digits, *s == '-' ? "-" : "");
    strcpy(more, "");
    s = take_digits(s + (*s == '-'), digits);
    if (*s == '/') {
        s = take_digits(s + 1, more);
        mpz_set_str(mpq_denref(q), more, 10);
    } else {
        const char *point = s;
        if (*s == '.') power = point + 1 - (s = take_digits(point + 1, digits));
        if (*s == 'e' || *s == 'E') {
            bool negative = s[1] == '-';
            s = take_digits(s + 1 + (negative || s[1] == '+'), more);
            if (strtol(more, NULL, 10) >= LONGEST) refuse("an exponent is too large: %s", more);
            power += negative ? -strtol(more, NULL, 10) : strtol(more, NULL, 10);
        }
        mpz_ui_pow_ui(mpq_denref(q), 10, (unsigned long)labs(power));
    }
    if (*s || !mpz_sgn(mpq_denref(q))) refuse("no number ends in \"%.40s\"", s);
    mpz_set_str(mpq_numref(q), digits, 10);
    if (power > 0) {
        mpz_mul(mpq_numref(q), mpq_numref(q), mpq_denref(q));
        mpz_set_ui(mpq_denref(q), 1);
    }
    mpq_canonicalize(q);
    return q;
}

/* A number, or minus it. */
static rational turned(struct json *value, bool turn) {
    return turn ? minus(zero, number(value)) : number(value);
}

static rational not_negative(struct json *value) {
    rational q = number(value);
    if (mpq_sgn(q) < 0) refuse("a number is negative that is not to be: %Qd", q);
    return q;
}

/* ---- The question ---- */

/* A quantity has these; and weights, those that are not 0: of costs, of steps, three of each set. */
enum { CONSTANT, STOPPING, BOUND, FIXED };
enum { VISITS, ENDS, OTHER_ENDS, KINDS };

struct term { size_t place; rational weight; };
struct quantity { char *name; rational fixed[FIXED]; struct term *terms; size_t n_terms; };
struct step { rational after, value[2], slope; };  /* of the charge: its least, and greatest */

static size_t n, n_costs, *start_state;
static size_t n_sets, n_start, n_rows, n_steps;  /* rows: the objective among them */
static char **sets, *asked;              /* names of sets, in their order */
static bool *ends, *goal;                /* set by set: whether its ends count; states */
static struct set_list { size_t size, *sets; } *lies_in;  /* of each state, rising */
static bool anywhere, attention, charging, greatest, least, sharing, limited, ratio;
static bool totals, quantile, tail_mean; /* whether totals count; and what is asked of them */
static bool single;                      /* whether policies must not be mixed */
static rational discount, share, level, *start_part;
static struct quantity *quantities;      /* the objective, and the rows */
static struct step *steps;

static size_t weight_of(size_t set, int kind) { return n_costs + 1 + KINDS * set + (size_t)kind; }

static int by_name(const void *one_name, const void *other_name) {
    return strcmp(*(char *const *)one_name, *(char *const *)other_name);
}

static size_t set_of(const char *name) {
    char **place = bsearch(&name, sets, n_sets, sizeof *sets, by_name);
    if (!place) refuse("there is no set \"%s\"", name);
    return (size_t)(place - sets);
}

static void new_set(char *name) {
    sets = grown(sets, n_sets, sizeof *sets);
    sets[n_sets++] = name;
}

static int by_number(const void *one_set, const void *other_set) {
    size_t a = *(const size_t *)one_set, b = *(const size_t *)other_set;
    return a < b ? -1 : a > b;
}

static bool in_set(size_t set, size_t x) {
    const struct set_list *all = &lies_in[x];
    return all->size && bsearch(&set, all->sets, all->size, sizeof set, by_number);
}

static struct quantity *new_quantity(char *name) {
    for (size_t j = 1; j < n_rows; j++)
        if (!strcmp(quantities[j].name, name)) refuse("two rows are called %s", name);
    quantities = grown(quantities, n_rows, sizeof *quantities);
    quantities[n_rows] = (struct quantity){.name = name, .fixed = {zero, zero, zero}};
    return &quantities[n_rows++];
}

static void add_term(struct quantity *q, size_t place, rational weight) {
    for (struct term *term = q->terms; term < q->terms + q->n_terms; term++)
        if (term->place == place) {
            term->weight = plus(term->weight, weight);
            return;
        }
    q->terms = grown(q->terms, q->n_terms, sizeof *q->terms);
    q->terms[q->n_terms++] = (struct term){place, weight};
}

/* Weights of a quantity, or of minus it. */
static void read_quantity(struct quantity *q, struct json *value, bool turn) {
    q->fixed[CONSTANT] = turned(get(value, "constant"), turn);
    for (struct json *term = list(get(value, "terms")); term; term = term->next) {
        struct json *kind = after(list(term)), *what = after(kind);
        rational weight = turned(list(term), turn);
        size_t place;
        if (says(kind, "cost")) {
            place = whole(what, n_costs);
        } else if (says(kind, "visits")) {
            place = weight_of(set_of(string(what)), VISITS);
        } else if (says(kind, "end")) {
            place = weight_of(set_of(string(what)), mpq_sgn(weight) < 0 ? OTHER_ENDS : ENDS);
            ends[set_of(what->text)] = true;
            if (mpq_sgn(weight) < 0) {  /* P(end) = 1 - P(no such end) */
                q->fixed[CONSTANT] = plus(q->fixed[CONSTANT], weight);
                weight = minus(zero, weight);
                q->fixed[STOPPING] = plus(q->fixed[STOPPING], weight);
            }
        } else refuse("no quantity is called \"%s\"", string(kind));
        add_term(q, place, weight);
    }
    for (struct term *term = q->terms; term < q->terms + q->n_terms; term++)
        if (term->place < n_costs && mpq_sgn(term->weight) < 0) refuse("costs count negatively");
}

static void read_failure(struct json *stated) {
    bool none = is(stated, 'n');
    limited = ratio || !none;
    if (!limited) return;
    struct quantity *failure = new_quantity("failure");
    failure->fixed[STOPPING] = one;
    add_term(failure, weight_of(set_of("goal"), OTHER_ENDS), one);
    least = says(stated, "least");
    sharing = is(stated, '{');
    if (sharing) share = not_negative(get(stated, "share"));
    else if (!least) failure->fixed[BOUND] = none ? one : number(stated);
    if (less(one, share)) refuse("a share is no probability");
    if ((sharing || least) && less(discount, one))
        refuse("a share, or least failure, is of the real probability: without discount");
}

static void read_row(struct json *row) {
    struct json *most = found(row, "at_most");
    struct quantity *q = new_quantity(kept(string(get(row, "name"))));
    read_quantity(q, get(row, "quantity"), !most);
    q->fixed[BOUND] = minus(turned(most ? most : get(row, "at_least"), !most), q->fixed[CONSTANT]);
    q->fixed[CONSTANT] = zero;
}

static void read_charge(struct json *step) {
    for (; step; step = step->next, n_steps++) {
        struct json *value = after(list(step)), *other = after(value);
        rational a = turned(value, greatest), b = turned(other, greatest);
        steps = grown(steps, n_steps, sizeof *steps);
        steps[n_steps] = (struct step){.after = number(list(step)),
                                       .value = {less(b, a) ? b : a, less(b, a) ? a : b},
                                       .slope = turned(after(other), greatest)};
        if (n_steps ? !less(steps[n_steps - 1].after, steps[n_steps].after)
                    : less(zero, steps[n_steps].after))
            refuse("a charge is told from 0 on, fails");
    }
    if (!n_steps) refuse("a charge has some value");
}

static void read_start(struct json *begin) {
    rational total = zero;
    for (; begin; begin = begin->next, n_start++) {
        start_part = grown(start_part, n_start, sizeof *start_part);
        start_state = grown(start_state, n_start, sizeof *start_state);
        start_part[n_start] = not_negative(list(begin));
        start_state[n_start] = whole(after(list(begin)), n);
        total = plus(total, start_part[n_start]);
    }
    if (!mpq_sgn(total)) refuse("the start is no distribution");
    for (size_t i = 0; i < n_start; i++) start_part[i] = over(start_part[i], total);
}

static void read_question(struct json *line) {
    struct json *where = get(line, "give_up"), *gamma = get(line, "discount");
    struct json *charge = found(line, "charge"), *quantile_of = found(line, "quantile");
    struct json *mean_of = found(line, "tail_mean");
    struct json *objective = get(line, "objective");
    if (!says(get(line, "format"), "ssp-lp certificate 1")) refuse("the format is not known");
    asked = kept(string(get(line, "asked")));
    n = whole(get(line, "states"), ALL / SHORTEST);
    n_hashed = 1 + n;
    n_costs = whole(get(line, "costs"), 1000);
    new_set("goal");
    for (struct json *set = list(get(line, "sets")); set; set = set->next)
        new_set(kept(string(set)));
    qsort(sets, n_sets, sizeof *sets, by_name);
    ends = zeros(n_sets, 1);
    read_start(list(get(line, "start")));
    anywhere = says(where, "anywhere");
    attention = says(where, "attention");
    if (!anywhere && !attention && !says(where, "dead_ends"))
        refuse("give_up is \"%s\"", string(where));
    charging = truth(get(line, "charge_failing_step"));
    greatest = truth(get(line, "greatest"));
    ratio = found(line, "ratio") && truth(found(line, "ratio"));
    single = found(line, "deterministic") && truth(found(line, "deterministic"));
    if (ratio && greatest) refuse("a ratio is to be small");
    discount = is(gamma, 'n') ? one : number(gamma);
    if (mpq_sgn(discount) <= 0 || less(one, discount)) refuse("a discount lies in (0, 1)");
    read_quantity(new_quantity("objective"), objective, greatest);
    read_failure(get(line, "failure"));
    for (struct json *row = list(get(line, "rows")); row; row = row->next) read_row(row);
    quantile = quantile_of;
    tail_mean = mean_of;
    totals = charge || quantile || tail_mean;
    if (!!charge + quantile + tail_mean > 1) refuse("one question of totals");
    if (charge) read_charge(list(charge));
    if (quantile || tail_mean) {
        level = number(quantile ? quantile_of : mean_of);
        if (!ratio || less(discount, one) || get(objective, "terms")->first
            || !says(get(objective, "constant"), "0"))
            refuse("a quantile has no discount and no objective, and is one given success");
        if (tail_mean && (mpq_sgn(level) < 0 || !less(level, one)))
            refuse("a level lies in [0, 1)");
    }
    end_line();
    n_lasting = n_made;
}

/* ---- The model ---- */

struct outcome { uint32_t pair, state, other; };  /* and another one that comes to the state */
struct move { size_t state; rational chance; mpz_t part, further, total; struct node *node; };

static size_t n_pairs, n_outcomes, *first_pair;  /* pairs of a state and an action; of each state */
static uint32_t *home;                   /* of each pair: its state */
static bool *costless, *stays, *keeps;   /* it costs nothing; avoids the goal; is asked of v; */
static bool *waits;                      /* costs nothing, and adds nothing to the total */
static struct outcome *outcomes;
static uint32_t *coming;                 /* 1 + an outcome that comes to each state, or 0 */
static mpz_t unit;                       /* of totals: 1 / unit */
static size_t state;                     /* that is read, */
static char *state_name, *action;        /* and its action: with part / sum it comes to a state, */
static struct move *moves;               /* and so much further in units of totals; */
static size_t n_moves;
static mpz_t sum;
static bool *counted;                    /* costs that some quantity counts */
static rational *paid, *least_paid;      /* means of its costs, and 1, times the sum; least means */
static char digest[2 * EVP_MAX_MD_SIZE + 1];

static rational read_cost(struct json *stated, bool counts) {
    bool varies = is(stated, '[');
    struct json *each = varies ? stated->first : NULL;
    rational mean = zero, cost = varies ? zero : not_negative(stated);
    for (struct move *move = moves; move < moves + n_moves; move++, each = after(each)) {
        if (varies) cost = not_negative(each);
        if (varies) mean = plus(mean, times(of(move->part), cost));
        if (!counts) continue;
        mpz_lcm(unit, unit, mpq_denref(cost));
        floor_of(move->further, cost, unit);
    }
    if (each) refuse("as many costs as outcomes, fails");
    return varies ? mean : times(of(sum), cost);
}

static void read_pair(struct json *stated) {
    static size_t room;
    struct json *chances = after(list(stated)), *costs = after(chances);
    mpz_t scale;
    mpz_init_set_ui(scale, 1);
    action = string(list(stated));
    n_moves = 0;
    for (struct json *each = list(chances); each; each = each->next, n_moves++) {
        if (n_moves == room) {
            moves = grown(moves, room, sizeof *moves);
            mpz_inits(moves[room].part, moves[room].further, moves[room].total, NULL);
            room++;
        }
        moves[n_moves].chance = not_negative(list(each));
        moves[n_moves].state = whole(after(list(each)), n);
        mpz_lcm(scale, scale, mpq_denref(moves[n_moves].chance));
    }
    mpz_set_ui(sum, 0);
    for (struct move *move = moves; move < moves + n_moves; move++) {
        floor_of(move->part, move->chance, scale);
        mpz_add(sum, sum, move->part);
    }
    mpz_clear(scale);
    if (!mpz_sgn(sum)) refuse("probabilities >= 0, not all of them 0");
    size_t count = 0;
    for (struct json *cost = list(costs); cost; cost = cost->next, count++)
        if (count < n_costs) paid[count] = read_cost(cost, totals && !count);
    if (count != n_costs || !count) refuse("as many costs as are said to be there, fails");
    paid[n_costs] = of(sum);
}

/* The sets that the state lies in, of which none counts twice. */
static void read_sets(struct json *stated) {
    struct set_list *all = &lies_in[state];
    bool is_known = all->sets;
    for (; stated && !is_known; stated = stated->next) {
        all->sets = grown(all->sets, all->size, sizeof *all->sets);
        all->sets[all->size++] = set_of(string(stated));
    }
    if (is_known || !all->size) return;
    qsort(all->sets, all->size, sizeof *all->sets, by_number);
    size_t size = 0;
    for (size_t i = 0; i < all->size; i++)
        if (!size || all->sets[i] != all->sets[size - 1]) all->sets[size++] = all->sets[i];
    all->size = size;
    goal[state] = in_set(set_of("goal"), state);
}

/* Read the question and the model, and do this with the actions of each state. */
static void read_model(void (*use)(struct json *)) {
    unsigned char bytes[EVP_MAX_MD_SIZE];
    char digits[sizeof digest] = "";
    unsigned size;
    n_bytes = 0;
    if (gzrewind(file)) fail("the file cannot be read twice, as a pipe cannot");
    EVP_DigestInit_ex(hash, EVP_sha256(), NULL);
    n_lines = 0;
    struct json *line = next_line(true);
    if (!asked) {
        read_question(line);
        paid = many_zeros(n_costs + 1);
        least_paid = many_zeros(n_costs + 1);
        counted = zeros(n_costs, sizeof *counted);
        for (size_t j = 0; j < n_rows; j++)
            for (size_t i = 0; i < quantities[j].n_terms; i++)
                if (quantities[j].terms[i].place < n_costs && mpq_sgn(quantities[j].terms[i].weight))
                    counted[quantities[j].terms[i].place] = true;
        first_pair = zeros(n + 1, sizeof *first_pair);
        coming = zeros(n, sizeof *coming);
        goal = zeros(n, sizeof *goal);
        lies_in = zeros(n, sizeof *lies_in);
    }
    for (state = 0; state < n; state++) {
        line = next_line(true);
        state_name = string(get(line, "name"));
        read_sets(list(get(line, "sets")));
        use(list(get(line, "actions")));
    }
    if (!EVP_DigestFinal_ex(hash, bytes, &size)) fail("there is no SHA-256");
    for (unsigned i = 0; i < size; i++) sprintf(digits + 2 * i, "%02x", bytes[i]);
    if (*digest && strcmp(digest, digits)) fail("the file has changed while it was read");
    strcpy(digest, digits);
}

static void keep_outcome(size_t y) {
    outcomes = grown(outcomes, n_outcomes, sizeof *outcomes);
    outcomes[n_outcomes] = (struct outcome){(uint32_t)n_pairs, (uint32_t)y, coming[y]};
    coming[y] = (uint32_t)++n_outcomes;
    if (n_outcomes > UINT32_MAX / 2) fail("there are too many outcomes");
}

static void keep_graph(struct json *actions) {
    for (; actions; actions = actions->next, n_pairs++) {
        read_pair(actions);
        home = grown(home, n_pairs, sizeof *home);
        costless = grown(costless, n_pairs, sizeof *costless);
        waits = grown(waits, n_pairs, sizeof *waits);
        home[n_pairs] = (uint32_t)state;
        costless[n_pairs] = waits[n_pairs] = true;
        for (size_t cost = 0; cost < n_costs; cost++)
            if (mpq_sgn(paid[cost]) && counted[cost]) costless[n_pairs] = false;
        for (struct move *move = moves; move < moves + n_moves; move++) {
            if (!mpz_sgn(move->part)) continue;
            keep_outcome(move->state);
            if (totals && mpz_sgn(move->further)) waits[n_pairs] = false;
        }
        if (less(discount, one)) keep_outcome(n);
    }
    first_pair[state + 1] = first_pair[n + 1] = n_pairs;
    end_line();
}

/* ---- What follows from the graph ---- */

static bool *live, *giving_up, *sure;    /* states with a way to the goal; to stop in; that keep */
static bool *wandering, *avoiding;       /* the goal sure; to go on in for ever by what takes */
static bool may_fail;                    /* nothing; to avoid the goal in for ever */

static bool *copied(const bool *flags, size_t count) {
    return memcpy(zeros(count, 1), flags, count);
}

/* The part of a set of states in which each has no pair, or one that stays in it; or, if so asked,
 * of which all pairs stay. Pairs are those that are allowed, of which those that stay are left. */
static bool *shrunk(const bool *states, bool *allowed, bool all) {
    bool *inside = copied(states, n + 1);
    uint32_t *ahead = zeros(n + 1, sizeof *ahead);
    uint32_t *ways = zeros(n + 1, sizeof *ways);  /* to stay, or 1 */
    size_t size = 0;
    for (size_t pair = 0; pair < n_pairs; pair++) {
        uint32_t x = home[pair];
        allowed[pair] = allowed[pair] && inside[x];
        if (allowed[pair] && !(all && ways[x])) ways[x]++;
    }
    for (size_t x = 0; x <= n; x++)
        if (!inside[x] || (!all && !ways[x] && first_pair[x] < first_pair[x + 1]))
            ahead[size++] = (uint32_t)x;
    while (size) {
        uint32_t y = ahead[--size];
        inside[y] = false;
        for (uint32_t i = coming[y]; i; i = outcomes[i - 1].other) {
            uint32_t pair = outcomes[i - 1].pair, x = home[pair];
            if (!allowed[pair]) continue;
            allowed[pair] = false;
            if (ways[x] && !--ways[x]) ahead[size++] = x;
        }
    }
    free(ahead);
    free(ways);
    return inside;
}

/* What a quantity counts on arriving in a state: of visits alone, or of ends too; but for costs. */
static rational arrivals(const struct quantity *q, size_t x, bool of_ends) {
    rational count = zero;
    for (const struct term *term = q->terms; term < q->terms + q->n_terms; term++) {
        if (term->place <= n_costs) continue;
        size_t set = (term->place - n_costs - 1) / KINDS, kind = (term->place - n_costs - 1) % KINDS;
        if (kind != VISITS && (!of_ends || live[x])) continue;
        if (in_set(set, x) == (kind != OTHER_ENDS)) count = plus(count, term->weight);
    }
    return count;
}

/* Refuse quantities that have no meaning; pairs after which they count a visit are not costless. */
static void check_quantities(void) {
    bool *seen = zeros(n + 1, 1);
    for (size_t x = 0; x <= n; x++) {
        n_made = n_lasting;
        for (size_t i = 0; i < lies_in[x].size && live[x]; i++)
            if (ends[lies_in[x].sets[i]]) refuse("not all states end: %s", sets[lies_in[x].sets[i]]);
        for (size_t j = 0; j < n_rows; j++) {
            int sign = mpq_sgn(arrivals(&quantities[j], x, false));
            if (sign < 0) refuse("visits count negatively in %s", quantities[j].name);
            seen[x] = seen[x] || (live[x] && sign);
        }
    }
    for (struct outcome *o = outcomes; o < outcomes + n_outcomes; o++)
        if (seen[o->state]) costless[o->pair] = false;
    free(seen);
}

/* Where the goal can surely be reached, by pairs that keep it sure. */
static void find_sure(const bool *not_goal) {
    for (bool shrinks = true; shrinks;) {
        bool *either = copied(sure, n + 1);
        for (size_t x = 0; x <= n; x++) either[x] = sure[x] || goal[x];
        memset(keeps, true, n_pairs);
        bool *inside = shrunk(either, keeps, false), *allowed = copied(keeps, n_pairs);
        bool *lost = shrunk(not_goal, allowed, true);
        shrinks = false;
        for (size_t x = 0; x <= n; x++)
            if (sure[x] && (lost[x] || !inside[x])) shrinks = true, sure[x] = false;
        free(either);
        free(inside);
        free(allowed);
        free(lost);
    }
}

static void follow_graph(void) {
    bool *not_goal = zeros(n + 1, 1), surely = true;
    live = zeros(n + 1, 1);
    giving_up = zeros(n + 1, 1);
    keeps = memset(zeros(n_pairs, 1), true, n_pairs);
    stays = copied(keeps, n_pairs);
    for (size_t x = 0; x <= n; x++) {
        not_goal[x] = !goal[x];
        if (goal[x] && first_pair[x] < first_pair[x + 1])
            refuse("a goal has actions: state %zu", x);
    }
    bool *dead = shrunk(not_goal, keeps, true);
    avoiding = shrunk(not_goal, stays, false);
    for (size_t x = 0; x <= n; x++) {
        live[x] = not_goal[x] && !dead[x];
        avoiding[x] = avoiding[x] && live[x];
        giving_up[x] = live[x] && (anywhere || (attention && avoiding[x]));
    }
    check_quantities();
    for (size_t pair = 0; pair < n_pairs; pair++) waits[pair] = waits[pair] && costless[pair];
    wandering = shrunk(live, costless, false);
    sure = copied(live, n + 1);
    find_sure(not_goal);
    for (size_t i = 0; i < n_start; i++)
        if (mpq_sgn(start_part[i]) && !sure[start_state[i]])
            surely = surely && goal[start_state[i]];
    if (least && !surely) sharing = true, share = one;
    may_fail = !limited || sharing || mpq_sgn(quantities[1].fixed[BOUND]);
    if (!may_fail && !surely) refuse("failure 0: the goal can be reached surely, fails");
    if (may_fail) memset(keeps, true, n_pairs);
    free(not_goal);
    free(dead);
}

static void forget_graph(void) {
    void *arrays[] = {home, costless, waits, outcomes, coming};
    for (size_t i = 0; i < sizeof arrays / sizeof *arrays; i++) free(arrays[i]);
}

/* ---- The proof ---- */

struct stair { mpz_t start; rational after, value, slope; };  /* value + slope * (total - after) */
struct charge { struct stair *stairs; size_t size; };  /* of a total: by the last one before it */
struct column {
    const char *name;
    struct quantity *counts;     /* what it bounds from below */
    long member;                 /* of whose decisions it is asked; NONE: of all that is possible */
    const bool *stops;           /* then: where it is asked of stopping, besides giving up */
    struct charge *charge;       /* at the goal; of a member it counts negatively */
    struct column *slope;        /* of its numbers from the cap on */
    bool is_of_states;           /* it tells of nodes from the cap on alone */
    size_t place;                /* among the shared ones, or those of a member */
};
/* Decisions that are left at a node in a case: to stop, and each action; and whether one who does
 * not stop there may wander by those that are left. */
struct choice { size_t state; mpz_t total; bool *left, wanders; };
/* A case of the proof: policies whose decisions are left, and thresholds of a tail mean, in units
 * beyond a total, and up to an end; the first total at the goal there, if there is one. */
struct range {
    rational *prices, after, end;
    mpz_t first;
    bool is_met;
    struct charge charge;
    struct choice *choices;
    size_t n_choices;
};
struct node {
    size_t state;
    mpz_t total;                 /* in units of totals; from the cap on: the cap */
    mpz_t *after;                /* of each shared column: arrival + y, in units */
    mpz_t **of_member;           /* of each member: the same of its columns, where it decides */
    int32_t *decision;           /* of each member */
    size_t line;
};

static size_t n_columns, n_shared, n_members, each_member, n_nodes;  /* each_member: columns */
static struct column *columns, *members, *least_failure;  /* first: v, of each case */
static struct quantity *turned_rows, nothing_counts;  /* minus the objective and each row */
static mpz_t *arrived, *arrived_member;  /* of shared columns, of a member's: in the state read */
static struct arrival { size_t place; mpz_t count; } **ended;  /* of members' columns, not 0, */
static size_t *n_ended;                  /* and how many, in each state that has ended */
static struct node *nodes;               /* by state and total, the last of each state its cap */
static size_t *first_node;               /* of each state */
static struct range *cases;              /* and at their end what is beyond all of them */
static size_t n_cases;
static struct charge charge_above, rise; /* of the lottery; what charges rise by in the end */
static rational *weights, claim[2], threshold;  /* claim: at least, at most */
static mpz_t units, cap;                 /* in 1, 10^60 or as said; in units of totals */

static size_t read_numbers(rational **numbers, struct json *stated) {
    size_t count = 0;
    for (; stated; stated = stated->next) {
        *numbers = grown(*numbers, count, sizeof **numbers);
        (*numbers)[count++] = not_negative(stated);
    }
    return count;
}

/* A total as a number of units. */
static mpz_srcptr in_units(rational total) {
    rational scaled = times(total, of(unit));
    if (mpz_cmp_ui(mpq_denref(scaled), 1)) refuse("%Qd is a sum of costs, fails", total);
    return mpq_numref(scaled);
}

static struct column *make_column(struct column *y, const char *name, struct charge *charge) {
    y->name = name;
    y->counts = &nothing_counts;
    y->member = NONE;
    y->place = (size_t)(y - columns);
    y->charge = totals ? charge : NULL;
    y->is_of_states = charge == &rise;
    y->stops = avoiding;
    return y;
}

static struct quantity *empty(size_t count) {
    struct quantity *all = zeros(count, sizeof *all);
    for (size_t j = 0; j < count; j++)
        for (int i = 0; i < FIXED; i++) all[j].fixed[i] = zero;
    return all;
}

/* The objective and, at prices of a case, the rows. */
static struct quantity *priced(const struct range *range) {
    struct quantity *all = empty(1);
    rational *weights_of = many_zeros(weight_of(n_sets, 0));
    for (size_t j = 0; j < n_rows; j++) {
        rational price = j ? range->prices[j - 1] : one;
        for (int i = 0; i < FIXED; i++)
            all->fixed[i] = plus(all->fixed[i], times(price, quantities[j].fixed[i]));
        for (size_t i = 0; i < quantities[j].n_terms; i++) {
            const struct term *term = &quantities[j].terms[i];
            weights_of[term->place] = plus(weights_of[term->place], times(price, term->weight));
        }
    }
    for (size_t place = 0; place < weight_of(n_sets, 0); place++)
        if (mpq_sgn(weights_of[place])) add_term(all, place, weights_of[place]);
    free(weights_of);
    return all;
}

static mpz_t *many_whole(size_t count) {
    mpz_t *array = zeros(count, sizeof *array);
    for (size_t i = 0; i < count; i++) mpz_init(array[i]);
    return array;
}

static void make_columns(void) {
    rational minus_one = minus(zero, one);
    struct quantity *steps_taken = empty(1);
    nothing_counts = *empty(1);
    add_term(steps_taken, n_costs, minus_one);
    turned_rows = empty(n_rows);
    for (size_t j = 0; j < n_rows; j++) {
        for (int i = 0; i < FIXED; i++)
            turned_rows[j].fixed[i] = times(minus_one, quantities[j].fixed[i]);
        for (size_t i = 0; i < quantities[j].n_terms; i++)
            add_term(&turned_rows[j], quantities[j].terms[i].place,
                     times(minus_one, quantities[j].terms[i].weight));
    }
    each_member = 1 + n_rows + totals;
    n_columns = n_cases + totals + sharing + n_members * each_member;
    members = columns = zeros(n_columns, sizeof *columns);
    for (size_t c = 0; c < n_cases; c++) {
        struct column *v = make_column(members++, "v", &cases[c].charge);
        v->stops = wandering;
        v->slope = totals ? columns + n_cases : NULL;
        v->counts = priced(&cases[c]);
    }
    if (totals) make_column(members++, "slope", &rise);
    if (sharing) {
        least_failure = make_column(members++, "w", NULL);
        least_failure->is_of_states = true;
        least_failure->counts = &quantities[1];
    }
    n_shared = (size_t)(members - columns);
    struct column *y = members;
    for (long m = 0; m < (long)n_members; m++) {  /* steps, objective, rows, and its slope */
        make_column(y, "- steps", NULL)->counts = steps_taken;
        for (size_t j = 0; j < n_rows; j++) {
            make_column(y + 1 + j, quantities[j].name, j ? NULL : &charge_above);
            y[1 + j].counts = &turned_rows[j];
        }
        if (totals) y[1].slope = make_column(y + 1 + n_rows, "- slope", &rise);
        for (size_t j = 0; j < each_member; j++, y++) {
            y->member = m;
            y->place = j;
        }
    }
    arrived = many_whole(n_shared);
    arrived_member = many_whole(each_member);
    ended = zeros(n + 1, sizeof *ended);
    n_ended = zeros(n + 1, sizeof *n_ended);
    n_lasting = n_made;
}

static struct choice *choice_at(const struct range *range, size_t x, mpz_srcptr total) {
    for (size_t i = 0; i < range->n_choices; i++)
        if (range->choices[i].state == x && !mpz_cmp(range->choices[i].total, total))
            return &range->choices[i];
    return NULL;
}

/* The decisions of a part of what is left at a node in a case. */
static bool *read_part(struct json *decisions, const bool *left, size_t n_actions) {
    bool *part = zeros(n_actions + 1, 1);
    for (; decisions; decisions = decisions->next) {
        size_t place = says(decisions, "stop") ? 0 : 1 + whole(decisions, n_actions);
        part[place] = left[place];
    }
    return part;
}

/* Cases of a tree, or the only one. */
static void read_cases(struct json *tree, struct range range) {
    if (single && found(tree, "parts")) {
        size_t x = whole(get(tree, "state"), n), size = first_pair[x + 1] - first_pair[x];
        struct choice *above, here = {.state = x};
        mpz_init(here.total);
        floor_of(here.total, not_negative(get(tree, "total")), unit);
        if (!totals) mpz_set(here.total, cap);
        above = choice_at(&range, x, here.total);
        bool *left = above ? above->left : memset(zeros(size + 1, 1), true, size + 1);
        bool *missing = copied(left, size + 1);
        struct choice *outer = range.choices;
        size_t place = above ? (size_t)(above - outer) : range.n_choices;
        range.n_choices += !above;
        for (struct json *part = list(get(tree, "parts")); part; part = part->next) {
            range.choices = zeros(range.n_choices, sizeof *outer);
            if (outer) memcpy(range.choices, outer, (range.n_choices - !above) * sizeof *outer);
            here.left = read_part(list(list(part)), left, size);
            range.choices[place] = here;
            for (size_t i = 0; i <= size; i++) missing[i] = missing[i] && !here.left[i];
            read_cases(after(list(part)), range);
        }
        if (memchr(missing, true, size + 1)) refuse("each decision is in a part, fails");
        return;
    }
    if (read_numbers(&range.prices, list(get(tree, "prices"))) != n_rows - 1)
        refuse("a price a row, fails");
    cases = grown(cases, n_cases + 1, sizeof *cases);
    mpz_init(range.first);
    cases[n_cases++] = range;
}

static void read_head(struct json *head) {
    rational total = zero;
    if (!says(get(head, "sha256"), digest))
        refuse("the SHA-256 is not that of the question and the model");
    if (totals) mpz_set(cap, in_units(not_negative(get(head, "cap"))));
    struct range range = {.after = minus(zero, one), .end = zero};
    if (!tail_mean) read_cases(single ? get(head, "cases") : head, range);
    for (struct json *each = tail_mean ? list(get(head, "cases")) : NULL; each; each = each->next) {
        range.end = number(list(each));
        read_cases(after(list(each)), range);
        range.after = times(range.end, of(unit));
    }
    if (!n_cases) refuse("one case at least, fails");
    mpz_init(range.first);
    cases[n_cases] = range;
    if (tail_mean) threshold = number(get(head, "threshold"));
    n_members = read_numbers(&weights, list(get(head, "weights")));
    for (size_t m = 0; m < n_members; m++) total = plus(total, weights[m]);
    if (!mpq_equal(total, one)) refuse("weights are >= 0 and sum to 1, fails");
    bool mixed = single;
    for (size_t m = 0; m < n_members; m++) mixed = mixed && !mpq_equal(weights[m], one);
    if (mixed) refuse("no policies are mixed, fails");
    claim[0] = number(list(get(head, "claim")));
    claim[1] = number(after(list(get(head, "claim"))));
    if (quantile) in_units(claim[0]);
    if (found(head, "one")) {
        rational told = number(found(head, "one"));
        if (mpz_cmp_ui(mpq_denref(told), 1) || less(told, one))
            refuse("units are parts of 1, fails");
        mpz_set(units, mpq_numref(told));
    }
}

/* A node of the state at the cap, of which nothing is told yet. */
static struct node *new_node(void) {
    nodes = grown(nodes, n_nodes, sizeof *nodes);
    struct node *node = &nodes[n_nodes++];
    *node = (struct node){.state = state, .line = n_lines};
    node->after = many_whole(n_shared);
    node->of_member = zeros(n_members, sizeof *node->of_member);
    node->decision = zeros(n_members, sizeof *node->decision);
    mpz_init_set(node->total, cap);
    for (size_t m = 0; m < n_members; m++) node->decision[m] = NONE;
    return node;
}

/* A number of a column, in a state where it may have one. */
static void read_number(struct node *node, const struct column *y, struct json *stated) {
    mpz_t z;
    mpz_init(z);
    floor_of(z, turned(stated, y->member != NONE), units);
    mpz_t *after_it = y->member == NONE ? node->after : node->of_member[y->member];
    if (live[state]) mpz_set(after_it[y->place], z);
    mpz_clear(z);
}

static void read_member(struct node *node, size_t m, struct json *entry, bool at_cap) {
    int32_t *decision = &node->decision[m];
    if (!live[state]) refuse("member %zu decides where nothing has ended, fails", m);
    if (says(entry, "stop")) *decision = STOP;
    else *decision = (int32_t)whole(entry, first_pair[state + 1] - first_pair[state]);
    if (*decision == STOP && !wandering[state] && !giving_up[state])
        refuse("member %zu stops where it may, fails", m);
    node->of_member[m] = many_whole(each_member);
    struct column *y = members + m * each_member;
    for (size_t j = 0; j < each_member; j++, y++)
        if (at_cap || !y->is_of_states) read_number(node, y, entry = after(entry));
}

/* What a line of the proof tells of a node, from the cap on or below it. */
static struct node *read_node(struct json *line, bool at_cap) {
    struct node *node = new_node();
    struct json *entry = list(get(line, "members"));
    struct json *v = tail_mean || single ? list(get(line, "v")) : get(line, "v");
    for (size_t c = 0; c < n_cases; c++, v = after(v)) read_number(node, &columns[c], v);
    if (totals && at_cap) read_number(node, columns->slope, get(line, "slope"));
    if (sharing && at_cap) read_number(node, least_failure, get(line, "w"));
    for (size_t m = 0; m < n_members; m++, entry = entry->next) {
        if (!entry) refuse("as many members as weights, fails");
        if (!is(entry, 'n')) read_member(node, m, list(entry), at_cap);
    }
    return node;
}

static int by_state_and_total(const void *one_node, const void *other_node) {
    const struct node *a = one_node, *b = other_node;
    int order = a->state < b->state ? -1 : a->state > b->state ? 1 : mpz_cmp(a->total, b->total);
    return order ? order : a->line < b->line ? -1 : 1;
}

static void read_proof(void) {
    struct json *line = next_line(true);
    size_t n_below = totals ? whole(get(line, "nodes"), ALL / SHORTEST) : 0;
    read_head(line);
    end_line();
    make_columns();
    for (state = 0; state < n; state++) {
        read_node(next_line(true), true);
        end_line();
    }
    new_node();  /* what a discount takes */
    for (size_t k = 0; k < n_below; k++) {
        line = next_line(true);
        state = whole(get(line, "state"), n);
        struct node *node = read_node(line, false);
        floor_of(node->total, not_negative(get(line, "total")), unit);
        if (!live[state] || mpz_cmp(node->total, cap) >= 0)
            refuse("a total below the cap, fails");
        end_line();
    }
    if (next_line(false)) refuse("there are more lines than are said to be there");
    qsort(nodes, n_nodes, sizeof *nodes, by_state_and_total);
    first_node = zeros(n + 1, sizeof *first_node);
    for (size_t i = 0; i < n_nodes; i++) first_node[nodes[i].state + 1] = i + 1;
}

/* ---- The inequalities ---- */

/* Node of a state at a total; at the cap it stands for all totals from there on, and for those at
 * which the state has ended. */
static struct node *node_of(size_t x, mpz_srcptr total) {
    size_t low = first_node[x], high = first_node[x + 1];
    if (!live[x] || mpz_cmp(total, cap) >= 0) return &nodes[high - 1];
    while (low < high) {  /* the last one up to the total is before low */
        size_t middle = (low + high) / 2;
        if (mpz_cmp(nodes[middle].total, total) <= 0) low = middle + 1;
        else high = middle;
    }
    if (low == first_node[x] || mpz_cmp(nodes[low - 1].total, total))
        refuse("no line tells of state %zu with %Qd", x, over(of(total), of(unit)));
    return &nodes[low - 1];
}

/* What a column takes from coming to a node on: arrival + y, in units. */
static mpz_srcptr after_of(const struct node *node, const struct column *y) {
    if (y->member == NONE) return node->after[y->place];
    if (node->of_member[y->member]) return node->of_member[y->member][y->place];
    for (size_t i = 0; i < n_ended[node->state]; i++)
        if (ended[node->state][i].place == y->place) return ended[node->state][i].count;
    return mpq_numref(zero);
}

/* What is left in each case is so at nodes that have a line; and who may wander by it. */
static void settle_choices(void) {
    for (struct range *range = cases; range < cases + n_cases; range++)
        for (size_t i = 0; i < range->n_choices; i++) {
            struct choice *here = &range->choices[i];
            if (totals && (!live[here->state] || mpz_cmp(here->total, cap) >= 0))
                refuse("decisions below the cap, fails");
            node_of(here->state, here->total);
            bool *allowed = copied(waits, n_pairs);
            for (size_t pair = 0; pair < n_pairs; pair++) {
                const struct choice *at_home = choice_at(range, home[pair], here->total);
                size_t number_of = pair - first_pair[home[pair]];
                allowed[pair] = allowed[pair] && (!at_home || at_home->left[1 + number_of]);
            }
            bool *inside = shrunk(live, allowed, false);
            here->wanders = inside[here->state];
            free(allowed);
            free(inside);
        }
}

/* A stair of a charge, from one total on. */
static void add_stair(struct charge *charge, rational after, rational value, rational slope) {
    charge->stairs = grown(charge->stairs, charge->size, sizeof *charge->stairs);
    struct stair *stair = &charge->stairs[charge->size++];
    *stair = (struct stair){.after = after, .value = value, .slope = slope};
    mpz_init(stair->start);
    floor_of(stair->start, after, unit);
    if (charge->size == 1) return;
    if (mpz_cmp(stair->start, stair[-1].start) < 0) refuse("a claim is a total, fails");
    if (mpz_cmp(stair->start, cap) >= 0) refuse("the charge is a line from the cap on, fails");
}

/* The charge of v, or of the lottery, with which their bounds are proved. */
static void build_charge(struct charge *charge, bool is_above, rational first, rational last) {
    rational step = over(one, of(unit)), before = minus(zero, step);
    if (quantile) {  /* late is for v from the claim on, for the lottery what is beyond it */
        add_stair(charge, before, zero, zero);
        add_stair(charge, is_above ? claim[0] : minus(claim[0], step), one, zero);
    } else if (tail_mean) {  /* at most z + max(total - z, 0) / (1 - level) for z between them */
        add_stair(charge, before, first, zero);
        add_stair(charge, first, first, one);
        add_stair(charge, last, last, over(one, minus(one, level)));
    } else {
        for (size_t i = 0; i < n_steps; i++)
            add_stair(charge, steps[i].after, steps[i].value[is_above], steps[i].slope);
    }
    if (mpq_sgn(charge->stairs[charge->size - 1].slope) < 0)
        refuse("the charge does not fall in the end, fails");
}

static void build_charges(void) {
    for (size_t c = 0; c < n_cases; c++) {
        rational first = over(of(cases[c].first), of(unit)), end = cases[c].end;
        if (tail_mean && (!cases[c].is_met || !cases[n_cases].is_met))
            refuse("an end is no total, fails");
        build_charge(&cases[c].charge, false, less(end, first) ? end : first, end);
    }
    build_charge(&charge_above, true, threshold, threshold);
    add_stair(&rise, zero, charge_above.stairs[charge_above.size - 1].slope, zero);
    n_lasting = n_made;
}

/* A total at the goal is told to the thresholds before it. */
static void meet(mpz_srcptr total) {
    for (struct range *range = cases; range <= cases + n_cases; range++)
        if (mpq_cmp_z(range->after, total) < 0
            && (!range->is_met || mpz_cmp(total, range->first) < 0)) {
            mpz_set(range->first, total);
            range->is_met = true;
        }
}

/* What a column counts of the charge on coming to the goal with a total, in units. */
static void charged(mpz_t count, const struct column *y, mpz_srcptr total) {
    size_t low = 0, high = y->charge->size;
    while (high - low > 1) {  /* the last stair that starts before the total, or the first */
        size_t middle = (low + high) / 2;
        if (mpz_cmp(y->charge->stairs[middle].start, total) < 0) low = middle;
        else high = middle;
    }
    const struct stair *stair = &y->charge->stairs[low];
    rational further = minus(over(of(total), of(unit)), stair->after);
    rational worth = plus(stair->value, times(stair->slope, further));
    floor_of(count, y->member == NONE ? worth : minus(zero, worth), units);
}

/* Weighted sum of costs. */
static rational dot(const struct quantity *q, rational *costs) {
    rational count = zero;
    for (const struct term *term = q->terms; term < q->terms + q->n_terms; term++)
        if (term->place <= n_costs) count = plus(count, times(term->weight, costs[term->place]));
    return count;
}

/* What failing in the state is charged: least means of the costs. */
static void find_least(struct json *actions) {
    bool charges = false;
    for (size_t cost = 0; cost < n_costs; cost++) least_paid[cost] = zero;
    if (!charging || (live[state] && !giving_up[state])) return;
    for (size_t pair = first_pair[state]; actions; actions = actions->next, pair++) {
        if (!anywhere && !stays[pair]) continue;
        read_pair(actions);
        for (size_t cost = 0; cost < n_costs; cost++) {
            rational mean = over(paid[cost], of(sum));
            if (!charges || less(mean, least_paid[cost])) least_paid[cost] = mean;
        }
        charges = true;
    }
}

static void arrive_with(mpz_t count, const struct column *y) {
    size_t mark = n_made;
    rational counts = arrivals(y->counts, state, true);
    if (!live[state]) counts = plus(counts, dot(y->counts, least_paid));
    floor_of(count, counts, units);
    n_made = mark;
}

/* What each column counts on arriving in the state, in units; of members where one decides. */
static void arrive(void) {
    bool decides = !live[state];
    for (size_t i = first_node[state]; i < first_node[state + 1]; i++)
        for (size_t m = 0; m < n_members; m++) decides = decides || nodes[i].of_member[m];
    for (size_t c = 0; c < n_shared; c++) arrive_with(arrived[c], &columns[c]);
    for (size_t j = 0; j < each_member && decides; j++) arrive_with(arrived_member[j], &members[j]);
}

/* Keep what members' columns count on arriving where a run has ended. */
static void keep_ended(void) {
    for (size_t j = 0; j < each_member; j++) {
        if (!mpz_sgn(arrived_member[j])) continue;
        ended[state] = grown(ended[state], n_ended[state], sizeof **ended);
        struct arrival *each = &ended[state][n_ended[state]++];
        each->place = j;
        mpz_init_set(each->count, arrived_member[j]);
    }
}

static void add_arrivals(struct json *actions) {
    if (!live[state]) find_least(actions);
    arrive();
    if (!live[state]) keep_ended();
    for (; tail_mean && live[state] && actions; actions = actions->next) {
        read_pair(actions);
        for (struct move *move = moves; move < moves + n_moves; move++)
            for (size_t i = first_node[state]; i < first_node[state + 1]; i++) {
                mpz_add(move->total, nodes[i].total, move->further);
                if (goal[move->state] && mpz_sgn(move->part)) meet(move->total);
            }
    }
    for (size_t i = first_node[state]; i < first_node[state + 1]; i++) {
        for (size_t c = 0; c < n_shared; c++)
            mpz_add(nodes[i].after[c], nodes[i].after[c], arrived[c]);
        for (size_t m = 0; m < n_members; m++)
            for (size_t j = 0; j < each_member && nodes[i].of_member[m]; j++)
                mpz_add(nodes[i].of_member[m][j], nodes[i].of_member[m][j], arrived_member[j]);
    }
}

/* Whether an inequality of a column is asked of an action, of this number; or of a stop. */
static bool asked_of(const struct column *y, const struct node *node, int32_t choice, size_t pair) {
    if (y->is_of_states && mpz_cmp(node->total, cap)) return false;
    if (y->member != NONE) return true;
    const struct choice *here = y < columns + n_cases
        ? choice_at(&cases[y - columns], state, node->total) : NULL;
    if (choice == STOP)
        return may_fail && (y->stops[state] || giving_up[state])
               && (!here || here->left[0] || here->wanders);
    return keeps[pair] && (!here || here->left[1 + choice]);
}

/* A column's inequality at a node and the action that was read; a stop leads nowhere. */
static void check(const struct column *y, const struct node *node, bool stopping) {
    size_t mark = n_made;
    mpz_t left, right, goes, won, grows, all, z;
    mpz_inits(left, right, goes, won, grows, all, z, NULL);
    for (struct move *move = moves; move < moves + n_moves; move++) {
        bool has_ended = !live[move->state];
        if (!mpz_sgn(move->part)) continue;
        if (y->member != NONE && !has_ended && move->node->decision[y->member] == NONE)
            refuse("%s of member %ld decides after %s %s, fails", y->name, y->member, state_name,
                   action);
        mpz_add(all, all, move->part);
        mpz_addmul(goes, move->part, after_of(move->node, y));
        if (y->charge && goal[move->state]) {
            charged(z, y, move->total);
            mpz_addmul(won, move->part, z);
        } else if (y->slope && !has_ended && mpz_cmp(move->total, cap) > 0) {
            mpz_sub(z, move->total, cap);
            mpz_mul(z, z, move->part);
            mpz_addmul(grows, z, after_of(move->node, y->slope));
        }
    }
    /* y <= own + charge + discount * (arrival + y, and its growth) after the step
     *   + (1 - discount) * arrival where a discount ends it,
     * times the sum of the parts, and the denominator of the discount */
    mpz_mul(z, units, mpq_denref(discount));
    floor_of(right, plus(dot(y->counts, paid), stopping ? y->counts->fixed[STOPPING] : zero), z);
    mpz_addmul(right, won, mpq_denref(discount));
    mpz_addmul(right, goes, mpq_numref(discount));
    mpz_mul(grows, grows, mpq_numref(discount));
    mpz_fdiv_q(grows, grows, unit);
    mpz_add(right, right, grows);
    mpz_sub(z, mpq_denref(discount), mpq_numref(discount));
    mpz_mul(z, z, all);
    mpz_addmul(right, z, after_of(&nodes[n_nodes - 1], y));
    mpz_sub(left, after_of(node, y), (y->member == NONE ? arrived : arrived_member)[y->place]);
    mpz_mul(z, sum, mpq_denref(discount));
    mpz_mul(left, left, z);
    if (mpz_cmp(left, right) > 0) {
        mpz_mul(z, z, units);
        refuse("%s <= own + sum p %s at %s, total %Qd, %s fails: %.17g > %.17g", y->name, y->name,
               state_name, over(of(node->total), of(unit)), action,
               mpq_get_d(over(of(left), of(z))), mpq_get_d(over(of(right), of(z))));
    }
    mpz_clears(left, right, goes, won, grows, all, z, NULL);
    n_made = mark;
}

/* The inequalities of the action that was read, of this number, or of stopping, at each node. */
static void check_nodes(int32_t choice, size_t pair) {
    for (size_t i = first_node[state]; i < first_node[state + 1]; i++) {
        bool leads = false;
        for (struct column *y = columns; y < columns + n_columns; y++) {
            if (y->member != NONE && nodes[i].decision[y->member] != choice) {
                y += each_member - 1;  /* to the next member */
                continue;
            }
            if (!asked_of(y, &nodes[i], choice, pair)) continue;
            for (struct move *move = moves; !leads && move < moves + n_moves; move++) {
                mpz_add(move->total, nodes[i].total, move->further);
                if (mpz_sgn(move->part)) move->node = node_of(move->state, move->total);
            }
            leads = true;
            check(y, &nodes[i], choice == STOP);
        }
    }
}

static void check_state(struct json *actions) {
    static char stopping[] = "stopping";
    if (!live[state]) return;
    arrive();
    find_least(actions);
    for (int32_t choice = 0; actions; actions = actions->next, choice++) {
        read_pair(actions);
        check_nodes(choice, first_pair[state] + (size_t)choice);
    }
    n_moves = 0;
    mpz_set_ui(sum, 1);
    action = stopping;
    for (size_t cost = 0; cost < n_costs; cost++)
        paid[cost] = wandering[state] ? zero : least_paid[cost];
    paid[n_costs] = one;
    check_nodes(STOP, 0);
}

/* ---- The verdict ---- */

/* What a column proves at the start. */
static rational proved(const struct column *y) {
    rational bound = zero;
    mpz_srcptr nothing = mpq_numref(zero);
    mpz_t begun;
    mpz_init(begun);
    for (size_t i = 0; i < n_start; i++) {
        size_t x = start_state[i];
        if (!mpq_sgn(start_part[i])) continue;
        const struct node *node = node_of(x, y->is_of_states ? cap : nothing);
        if (y->member != NONE && live[x] && node->decision[y->member] == NONE)
            refuse("%s of member %ld decides at the start, fails", y->name, y->member);
        mpz_set_ui(begun, 0);
        if (y->charge && goal[x]) charged(begun, y, nothing);
        mpz_add(begun, begun, after_of(node, y));
        bound = plus(bound, times(start_part[i], of(begun)));
    }
    mpz_clear(begun);
    return plus(over(bound, of(units)), y->counts->fixed[CONSTANT]);
}

/* A bound in 25 decimals, rounded so that it holds, and as the fraction that it is. */
static void print_bound(const char *name, rational bound, bool up) {
    mpz_t scale, left;
    mpz_inits(scale, left, NULL);
    mpz_ui_pow_ui(scale, 10, 25);
    floor_of(left, up ? minus(zero, bound) : bound, scale);
    if (up) mpz_neg(left, left);
    const char *sign = mpz_sgn(left) < 0 ? "-" : "";
    mpz_abs(left, left);
    mpz_fdiv_qr(left, scale, left, scale);
    gmp_printf("  %-9s %s%Zd.%025Zd = %Qd\n", name, sign, left, scale, bound);
    mpz_clears(scale, left, NULL);
}

/* A bound of a ratio N / (1 - F) from one of N + price * (F - most): it is a ratio of two lines,
 * and least at the failure 0 or at the most. */
static rational given_success(rational bound, rational price, rational most) {
    rational at_none = plus(bound, times(price, most));
    bool some = less(most, one);
    if (!some && mpq_sgn(bound) < 0)
        refuse("0 <= cost + price * (failure - 1) of all policies, fails");
    rational at_most = some ? over(bound, minus(one, most)) : at_none;
    return less(at_most, at_none) ? at_most : at_none;
}

/* 1 - share * (1 - failure), of a bound of failure */
static rational budget(rational failure) { return minus(one, times(share, minus(one, failure))); }

static void conclude(void) {
    rational *taken = many_zeros(n_rows), *bound = many_zeros(n_rows), lower, upper;
    rational *most = many_zeros(n_rows);  /* what prices pay for: bounds, or what is taken */
    rational failed = NULL;
    for (size_t m = 0; m < n_members; m++)
        for (size_t j = 0; j < n_rows; j++) {
            rational each = minus(zero, proved(&members[m * each_member + 1 + j]));
            taken[j] = plus(taken[j], times(weights[m], each));
            if (j == 1 && (!failed || less(each, failed))) failed = each;
        }
    for (size_t j = 1; j < n_rows; j++) bound[j] = most[j] = quantities[j].fixed[BOUND];
    if (sharing) {  /* the least failure lies between what w proves and what a member does */
        bound[1] = budget(proved(least_failure));
        most[1] = budget(failed);
    }
    for (size_t j = 1; j < n_rows; j++)
        if (less(most[j], taken[j])) most[j] = taken[j];
    upper = taken[0];
    lower = tail_mean ? over(of(cases[n_cases].first), of(unit)) : NULL;
    for (size_t c = 0; c < n_cases; c++) {
        rational each = proved(&columns[c]), *prices = cases[c].prices;
        for (size_t j = 1; j < n_rows; j++)
            each = minus(each, times(prices[j - 1], most[j]));
        if (ratio) each = given_success(each, prices[0], most[1]);
        if (!lower || less(each, lower)) lower = each;
    }
    bool exceeds = false;
    for (size_t j = 1; j < n_rows; j++) {
        rational excess = minus(taken[j], bound[j]);
        mpq_ptr allowed = made();
        mpq_set_ui(allowed, 1, 1);
        mpz_ui_pow_ui(mpq_denref(allowed), 10, EXCESS);
        if (less(minus(zero, one), bound[j]) && less(bound[j], one))
            mpq_mul(allowed, allowed, bound[j]);
        mpq_abs(allowed, allowed);
        if (less(allowed, excess))
            refuse("lottery <= bound of row %s fails by %.17g", quantities[j].name,
                   mpq_get_d(excess));
        exceeds = exceeds || mpq_sgn(excess) > 0;
    }
    if (exceeds && single) refuse("a policy exceeds a row");
    if (ratio) {
        if (!less(taken[1], one)) refuse("the lottery reaches the goal, fails");
        rational given = over(upper, minus(one, taken[1]));
        if (less(upper, given)) upper = given;
    }
    if (quantile) {
        rational late = minus(one, level);
        if (less(late, upper)) refuse("the lottery exceeds the quantile as rarely, fails");
        if (exceeds) refuse("a quantile jumps where the lottery exceeds a row");
        if (!less(late, lower)) refuse("no lottery stays below the quantile as often, fails");
        lower = upper = claim[0];
    }
    if (greatest) {
        rational most_of = minus(zero, lower);
        lower = minus(zero, upper);
        upper = most_of;
    }
    if (less(upper, lower)) refuse("at least %Qd and at most %Qd contradict", lower, upper);
    if (less(lower, claim[0])) refuse("claimed is at least %Qd, fails: %Qd", claim[0], lower);
    if (less(claim[1], upper)) refuse("claimed is at most %Qd, fails: %Qd", claim[1], upper);
    printf("accepted: \"%s\"\n  SHA-256   %s\n", asked, digest);
    print_bound("at least", lower, false);
    print_bound("at most", upper, true);
    printf("  width     %.1e\n", mpq_get_d(minus(upper, lower)));
    for (size_t j = 1; j < n_rows; j++)
        if (less(bound[j], taken[j]))
            gmp_printf("  the lottery exceeds row %s by %Qd\n", quantities[j].name,
                       minus(taken[j], bound[j]));
}

int main(int count, char **arguments) {
    if (count != 2) fail("usage: check FILE");
    if (!(file = gzopen(arguments[1], "rb"))) fail("the file cannot be opened");
    gzbuffer(file, 1 << 18);
    FILE *packed = fopen(arguments[1], "rb");
    long size = packed && !fseek(packed, 0, SEEK_END) ? ftell(packed) : 0;
    most_bytes = size > (ALL - LINE) / TIMES ? ALL : LINE + TIMES * (size_t)(size > 0 ? size : 0);
    if (packed) fclose(packed);
    if (gzdirect(file)) refuse("the file is not gzip");
    if (!(hash = EVP_MD_CTX_new())) fail("there is not enough memory");
    mpz_inits(units, unit, cap, sum, NULL);
    mpz_ui_pow_ui(units, 10, DIGITS);
    mpz_set_ui(unit, 1);
    zero = share = threshold = made();
    one = of(unit);
    n_lasting = n_made;
    read_model(keep_graph);
    follow_graph();
    if (!single) forget_graph();
    read_proof();
    if (single) settle_choices();
    meet(mpq_numref(zero));
    meet(cap);
    read_model(add_arrivals);
    add_arrivals(NULL);  /* of what a discount takes */
    if (totals) build_charges();
    read_model(check_state);
    n_lines = 0;
    conclude();
    return 0;
}
