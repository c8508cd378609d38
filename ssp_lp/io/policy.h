/* A policy of ssp-lp, made for the model ${model}.
   States:
${states}
*/
#ifndef ${guard}
#define ${guard}
enum { ${name}_states = ${n_states}, ${name}_count = ${n_members} };
static const double ${name}_unit = ${unit};
static const char *const ${name}_actions[] = {${actions}};
typedef ${code} ${name}_code;
typedef struct {
    double upto; /* probability of this member and those before it */
    int layers, tails;
    const ${name}_code *decision; /* [layers][states] number of an action, or a code */
    const ${name}_code *tail; /* [tails][states] */
    const double *threshold; /* [states] total from which the last tail is followed */
    const double *levels; /* [layers + 1] totals, in place of multiples of a unit */
    const int *offsets; /* of decisions that are drawn, [states + 1] */
    const ${name}_code *action;
    const double *share; /* of each such action and those before it */
    const unsigned char *ends; /* [states] of a policy that acts everywhere */
    const ${name}_code *otherwise, *afterwards; /* [states] beside the plan, and after it */
} ${name}_member;

${tables}
static const ${name}_member ${name}_members[] = {
${members}
};

typedef struct { int member, tail, over, level; double paid; } ${name}_episode;
#define ${name}_BEGIN {-1, -1, -1, 0, 0.0}

/* The number of the action in a state: -1 to give up, -2 where the policy has no decision.

   episode: its memory, ${name}_BEGIN where it begins.
   state: its number, 0 .. ${name}_states - 1.
   total: paid so far, in multiples of ${name}_unit.
   uniform: drawn from [0, 1) at each call; the first one draws the lottery, too. */
static inline int ${name}_action(${name}_episode *episode, int state, double total, double uniform)
{
    const ${name}_member *member;
    double low = 0.0;
    int code, first, last;
    if (episode->member < 0) {
        episode->member = 0;
        while (episode->member < ${name}_count - 1 && uniform >= ${name}_members[episode->member].upto)
            low = ${name}_members[episode->member++].upto;
        uniform = (uniform - low) / (${name}_members[episode->member].upto - low);
    }
    member = &${name}_members[episode->member];
    if (member->ends && (episode->over > 0 || member->ends[state])) {
        episode->over = 1;
        return member->afterwards[state];
    }
    if (episode->tail < 0) { /* the layer, or from the cap on a tail, for good */
        first = 0, last = member->layers;
        if (member->levels) {
            double step = total - episode->paid;
            episode->paid = total;
            total = member->levels[episode->level] + step;
            while (first < last) { /* the level nearest to the total, the lower one of two */
                const int middle = (first + last) / 2;
                if (total - member->levels[middle] <= member->levels[middle + 1] - total)
                    last = middle;
                else
                    first = middle + 1;
            }
            episode->level = first;
            last = member->layers;
        } else {
            if (total < 1e15)
                total = (double)(long long)(total + 0.5);
            first = total >= last ? last : (int)total;
        }
        if (first >= last)
            episode->tail = total >= member->threshold[state] ? member->tails - 1 : 0;
    }
    if (episode->tail < 0)
        code = member->decision[(long)first * ${name}_states + state];
    else
        code = member->tail[(long)episode->tail * ${name}_states + state];
    if (code <= ${drawn}) {
        first = member->offsets[${drawn} - code], last = member->offsets[${drawn} - code + 1] - 1;
        while (first < last && uniform >= member->share[first])
            first++;
        code = member->action[first];
    }
    if (member->ends && code == -1) {
        episode->over = 1;
        return member->afterwards[state];
    }
    return member->ends && code == -2 ? member->otherwise[state] : code;
}

#endif
