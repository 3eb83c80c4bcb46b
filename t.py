import sys, time
sys.path.insert(0,'/work/main'); sys.dont_write_bytecode=True
import yaml
from beags_plugin.plugin import run_config as r
n=22
lines=["a0: &a0 !!python/tuple [1,1]"]
for i in range(1,n): lines.append(f"a{i}: &a{i} !!python/tuple [*a{i-1}, *a{i-1}]")
lines.append(f"? *a{n-1}\n: 1")
t=time.time()
yaml.load("\n".join(lines),Loader=r.RunConfigLoader); print("hash bomb 22 levels",time.time()-t)
t=time.time()
try:
    yaml.load("a: 1"+":1"*100000,Loader=r.RunConfigLoader)
except Exception as e: print(type(e),str(e)[:80])
print("sexagesimal 200kB",time.time()-t)
