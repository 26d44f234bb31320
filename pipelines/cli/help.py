"""The help texts of the commands."""

_WORDS = """\
words:
  env=hopper            reacher walker2d hopper halfcheetah ant swimmer bipedalwalker pendulum mountaincar lunarlander;
                        hopper_v5 and so on for gymnasium's newer MuJoCo environments
  depth=6               hidden neurons of the actor, the depth of the tree; [8,8] for two layers, 0 for a linear policy
  budget=quick          thesis (default; the thesis's own steps, hours), quick (minutes), smoke (seconds)
  seed=0                of training and pruning; every method is evaluated on the same episodes
  method=otr            otr, linear (with depth=0), pid (depth=1 unless given; pendulum); by imitation viper, lm_viper,
                        augtree, ndps; soft trees sdt, cdt (depth=[3,3]), pi_prl. Their depth is the tests on a path
  program=FILE          evaluate a program that you wrote, or a shipped one: mountaincar, mountaincar_simplified
  oracle=[256,256]      hidden layers of the network to imitate; trained first, by the same command that trains it alone
  trainer=fleet         train a sweep's runs of SAC together, some three times as fast; sb3 (default) is the reference
  algo=td3              ppo, trpo, sac, td3, ddpg, ars (method=linear); by default the thesis's for the environment, and
                        ppo_tree for soft trees, ddpg_pid for PID policies
  column=viper          a column of Table 4.1, a method and its depth, for sweeps over both: linear viper lm_viper ndps
                        pi_prl otr_6 otr_32
  certify=true          also the minimal tree on the environment's states, with the proof that it is the network
  simplify=true         also a shorter program, as far as the return on other episodes than the reported ones allows
  stages=[map,prune]    only these stages; a missing input names the command that makes it
  results_dir=PATH      where artefacts go (default: results, or OTR_RESULTS_DIR)
  launcher=joblib       how a sweep's jobs run: basic (one by one), joblib, slurm, submitit_local, ray
  tracking=mlflow       show runs as they go: none, tensorboard, mlflow
  algo.gamma=0.98       any key that --cfg shows; such a run gets a folder of its own
  debug=true            show tracebacks"""

HELP = {
    "otr-run": f"""\
Train a small ReLU actor, map it exactly to an oblique decision tree, prune the tree to what is reached, evaluate all of
them on the same 100 episodes, and print the program and the numbers. Or obtain the tree by another method. What is done
is skipped; what was stopped goes on.

{_WORDS}

examples:
  otr-run env=pendulum depth=6 budget=quick
  otr-run env=pendulum method=pid budget=quick
  otr-run env=lunarlander method=augtree depth=3 "oracle=[256]" budget=quick
  otr-run -m env=hopper,swimmer depth=6,32 "seed=range(0,10)" launcher=joblib
  otr-run +experiment=table_4_1 column=viper,otr_6 env=hopper
  otr-run +experiment=figure_4_6 budget=quick launcher=joblib
  otr-run env=mountaincar program=mountaincar""",
    "otr-plan": f"""\
List what otr-run with the same words would do: run, resume or skip for every job, and the time that is left. With
--jobs FILE also write the command of every job that is not done, one a line, for xargs or sbatch --array.

{_WORDS}

examples:
  otr-plan +experiment=table_4_1
  otr-plan -m env=pendulum depth=6,32 "seed=range(0,3)" budget=quick
  otr-plan +experiment=table_4_1 --jobs jobs.txt""",
    "otr-fit": """\
Learn an oblique tree for every label of a data set, score it on the training, validation and test part, and count the
leaves that the training rows reach. What a method tunes is tuned on the validation part. What is done is skipped.

words:
  data=bace             bace hiv sider tox21 pdbbind; breast_cancer digits diabetes need no files (see otr-data --help)
  method=otr            otr, otr_tuned, lcn, hhcart, tao, tao_l1, cart, augtree, model_tree (regression), linear
  seed=0                a sweep's seeds of one network are trained as one
  method.hidden=[4]     any key that --cfg shows; such a fit gets a folder of its own
  keep_trees=false      delete the trees once they are scored
  stages=[tune,fit]     only these stages
  results_dir=PATH      where artefacts go (default: results, or OTR_RESULTS_DIR)
  launcher=joblib       how a sweep's jobs run: basic (one by one), joblib, slurm, submitit_local, ray
  debug=true            show tracebacks

examples:
  otr-fit data=breast_cancer method=otr "method.hidden=[3]"
  otr-fit -m data=bace,hiv method=otr "seed=range(0,10)"
  otr-fit +experiment=table_4_2 launcher=joblib""",
    "otr-tabulate": """\
Write tables and figures from finished runs and fits: the thesis's tables, ours beside the published numbers, as
Markdown, CSV and LaTeX under results/tables; its figures from the runs of +experiment=figure_4_6, under
results/figures; or all runs or fits as one CSV file, with what its columns are.

reports, one or several (default: 4.1):
  4.1, 4.2              the tables of control and of data
  4.6                   the figure of the lander's return against depth: PNG, SVG, CSV
  4.7                   the figure of a policy of depth 2 as a program, before and after its tests are simplified
  certificates          what is proved of which policy
  runs                  all runs, a row a run and form of its policy (in Python: pipelines.report.load_runs)
  fits                  all fits of otr-fit, a row each (load_fits)
  all                   the tables, the figures and the certificates

words:
  table=4.1             the same as 4.1, and figure=4.6 as 4.6
  budget=quick          whose runs a figure shows; by default the thesis's if there are any, else quick
  evaluate=true         play the evaluation episodes of every run again first, and compare
  results_dir=PATH      where the runs lie (default: results, or OTR_RESULTS_DIR)

examples:
  otr-tabulate all
  otr-tabulate runs results_dir=results/local""",
    "otr-export": """\
Print the policy of a finished run as a program in another language, or write it to a file. The names of inputs and
actions are the environment's.

words:
  run=FOLDER            a run's folder: results/runs/hopper/otr/depth-6/quick/seed-0 or, shorter, what follows runs/
  format=c              text             if ... then ... else, as the thesis prints it
                        python           one function, without numpy
                        c                C99 for controllers: constant tables, no heap
                        structured_text  an IEC 61131-3 function block, for PLCs
                        latex, dot       for a paper (amsmath) and for Graphviz
                        onnx             standard operators, any number of states at once
                        json             nodes and leaves, for any other language
  tree=full             pruned (default; what the policy reaches), full, minimal (after certify=true), simplified
                        (after simplify=true), constant_gains (of method=pid: every leaf's gains averaged) or, for
                        format=c, compact: the network itself, the shortest form
  out=policy.c          a file, whose folder is made, or a folder that is there; without it the program is printed
  name=hopper           of the function, block or graph (default: policy)
  dtype=float           double (default) or float, for c and onnx
  precision=3           significant digits, for text, latex and dot; the other formats lose nothing
  results_dir=PATH      where the runs lie (default: results, or OTR_RESULTS_DIR)

examples:
  otr-export run=hopper/otr/depth-6/quick/seed-0 format=text
  otr-export run=hopper/otr/depth-6/quick/seed-0 format=c tree=compact dtype=float out=policy.c
  otr-export run=lunarlander/otr/depth-2/thesis/seed-0 format=dot | dot -Tsvg > lander.svg""",
    "otr-verify": """\
Check the certificate of a run that was made with certify=true: that its minimal tree and its network compute the same
function on the domain it names. No solver is used. A tree, an actor or a certificate that was changed is refused, with
the number of a leaf.

words:
  run=FOLDER            a run's folder: results/runs/pendulum/otr/depth-6/quick/seed-0 or, shorter, what follows runs/
  certificate=FILE      instead of the run's own; so tree=FILE (tree.json) and actor=FOLDER (of actor.json)
  results_dir=PATH      where the runs lie (default: results, or OTR_RESULTS_DIR)

examples:
  otr-run env=pendulum depth=6 budget=quick certify=true
  otr-verify run=pendulum/otr/depth-6/quick/seed-0""",
}
